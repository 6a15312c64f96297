#!/usr/bin/env bash
# The main job, headless: a recorded bag becomes a trajectory that physics has agreed to, with a report to look at.
#
#   bash ros2_ws/demo.sh [--strategy hooking|hanging|scooping|DIR] [--variant fg|arm] [--bag DIR] [--features auto|embedded|dinov2] [--out DIR]
#
# --strategy  what to do (default hooking), or the folder of a strategy, with --bag
# --variant   fg: a floating gripper moves the tool; arm: the Panda grasps and moves it (default arm)
# --bag       the recorded bag to replay (default bags/<strategy>)
# --features  what finds the contact: embedded ships with the package, dinov2 needs weights, auto takes what is at hand (default auto)
# --weights   of the features: a hub name (facebook/dinov2-base) or a local folder
# --out       folder for summary.json and report.html (default out/<strategy>_<variant>)
# --cameras   names of the cameras, as they stand in the topics /camera/NAME/... (default left right)
# --topics    /RECORDED:=/PLAYED ...: topics of the bag under other names
# --perception-params, --matcher-params, --planner-params, --verifier-params, --server-params, --robot-params FILE: parameters files
# --launch    FILE [NAME:=VALUE ...]: a launch file of your own starts the nodes instead
# --live      no bag: one trial in the simulated laboratory (--scenario, --object, --seed, --out), carried out by its arm and judged on the truth
# --tool, --target, --seed, --timeout: see python -m magic_bringup.demo --help
#
# Sets up the workspace first where that is needed. Exit status 0: a verified trajectory was published; with --live: the goal was truly reached.
set -uo pipefail
WS=$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd -P)
case " $* " in
  *" -h "* | *" --help "*) sed -n '2,/^set /{/^set /d;s/^# \{0,1\}//p}' "${BASH_SOURCE[0]}"; exit 0 ;;
esac
log=$(mktemp "${TMPDIR:-/tmp}/magic_setup.XXXXXX") || exit 1
trap 'rm -f "$log"' EXIT
# Quiet where there is nothing to do; a set-up that takes minutes shows that it is alive.
if [ -f "$WS/install/.build_state" ]; then
  bash "$WS/setup.sh" >"$log" 2>&1 || { cat "$log" >&2; exit 1; }
else
  bash "$WS/setup.sh" || exit 1
fi
. "$WS/env.sh" || exit 1
export OMP_NUM_THREADS=${OMP_NUM_THREADS:-2}
# A signal to this script ends the graph as well: it is passed on, and waited for.
module=magic_bringup.demo
case " $* " in *" --live "*) module=magic_lab.live ;; esac
python -m $module --root "$WS/.." "$@" &
child=$!
trap 'kill -INT $child 2>/dev/null' INT TERM HUP
status=0
wait $child || status=$?
while kill -0 $child 2>/dev/null; do wait $child; status=$?; done
exit $status
