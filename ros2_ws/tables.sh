#!/usr/bin/env bash
# The paper's Tables, measured here: every method and task in simulation, each figure beside the paper's, and from images too.
#
#   bash ros2_ws/tables.sh [--quick] [--only TABLE] [--jobs N] [--weights FEATURES=PATH] [--out DIR]
#
# --quick    a few cases of each cell, within 10 minutes on 2 cores that have nothing else to do; all cases else (4,900, some hours)
# --only     one table: I, II, III, IV, V, images, alphabet; may be given several times
# --jobs     cases at a time (default 2, or 1 on one core); the results do not depend on it
# --weights  weights of dinov2, dift or sd_dino, a hub name or a folder; rows without weights say so
# --out      folder for tables.txt, tables.csv, tables.html and cases.jsonl (default out/tables); the same folder goes on where it stopped
# --seed, --strategies: see python -m magic_verifier.tables --help
#
# Sets up the workspace first where that is needed.
set -uo pipefail
WS=$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd -P)
case " $* " in
  *" -h "* | *" --help "*) sed -n '2,/^set /{/^set /d;s/^# \{0,1\}//p}' "${BASH_SOURCE[0]}"; exit 0 ;;
esac
bash "$WS/setup.sh" || exit 1
. "$WS/env.sh" || exit 1
# Each case has a core of its own.
export OMP_NUM_THREADS=1
cd "$WS/.." && exec python -m magic_verifier.tables "$@"
