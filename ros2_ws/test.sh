#!/usr/bin/env bash
# Sets everything up (setup.sh) and runs every test. Arguments go to pytest: bash ros2_ws/test.sh -k transforms -x
set -uo pipefail
WS=$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd -P)
bash "$WS/setup.sh" || exit 1
. "$WS/env.sh" || exit 1
# Nothing of a test leaves this machine, and two runs at a time do not hear each other.
export ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST
export ROS_DOMAIN_ID=${ROS_DOMAIN_ID:-$((1 + $$ % 100))}
cores=$(nproc)
# All tests: by a worker for each core, a file at a time.  Some of them: in one process, where -s and --pdb work as well.
workers=$((cores < 4 ? cores : 4))
spread=()
[ $# -eq 0 ] && [ "$workers" -gt 1 ] && spread=(-p xdist.plugin -n "$workers" --dist loadfile)
export OMP_NUM_THREADS=${OMP_NUM_THREADS:-$((${#spread[@]} ? 1 : workers))}
# Only the plugins that the tests use: ROS brings pytest plugins of its own that newer versions of pytest refuse.
export PYTEST_DISABLE_PLUGIN_AUTOLOAD=1
cd "$WS/.." && exec python -m pytest -p pytest_timeout "${spread[@]}" "$@"
