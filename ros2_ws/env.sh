# To be sourced, from any folder, in bash or zsh: the Python environment, ROS 2 and the built workspace.
#
#   source ros2_ws/env.sh
#
# Sourcing it again changes nothing. ROS_DOMAIN_ID and ROS_AUTOMATIC_DISCOVERY_RANGE are left as they are.
if [ -n "${ZSH_VERSION:-}" ]; then
  eval '_magic_ws=${${(%):-%x}:A:h}' && _magic_shell=zsh
else
  _magic_ws=$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd -P) && _magic_shell=bash
fi
if [ ! -f "$_magic_ws/install/local_setup.bash" ] || [ ! -x "$_magic_ws/.venv/bin/python" ]; then
  echo "magic: the workspace is not set up yet; run: bash $_magic_ws/setup.sh" >&2
  unset _magic_ws _magic_shell
  return 1 2>/dev/null || exit 1
fi
# The scripts of ROS and colcon read variables that may be unset.
case $- in *u*) _magic_nounset=1; set +u ;; *) _magic_nounset= ;; esac
if [ -f /opt/ros/jazzy/setup.$_magic_shell ]; then
  case ":${AMENT_PREFIX_PATH:-}:" in *:/opt/ros/jazzy:*) ;; *) . /opt/ros/jazzy/setup.$_magic_shell ;; esac
else
  case ":${AMENT_PREFIX_PATH:-}:" in *":$_magic_ws/.venv:"*) ;; *) export AMENT_PREFIX_PATH=$_magic_ws/.venv${AMENT_PREFIX_PATH:+:$AMENT_PREFIX_PATH} ;; esac
  case ":${CMAKE_PREFIX_PATH:-}:" in *":$_magic_ws/.venv:"*) ;; *) export CMAKE_PREFIX_PATH=$_magic_ws/.venv${CMAKE_PREFIX_PATH:+:$CMAKE_PREFIX_PATH} ;; esac
  export ROS_DISTRO=jazzy ROS_VERSION=2 ROS_PYTHON_VERSION=3
fi
[ "${VIRTUAL_ENV:-}" = "$_magic_ws/.venv" ] || . "$_magic_ws/.venv/bin/activate"
. "$_magic_ws/install/local_setup.$_magic_shell"
# Faster discovery (see the file), unless the user has a profile of their own.
[ -n "${FASTRTPS_DEFAULT_PROFILES_FILE:-}" ] || export FASTRTPS_DEFAULT_PROFILES_FILE=$_magic_ws/fastdds.xml
[ -z "$_magic_nounset" ] || set -u
unset _magic_ws _magic_shell _magic_nounset
