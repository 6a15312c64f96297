"""The package's executables, which import the rest of it only when they have begun; those of server, bags
and laboratory are found here as well."""

from magic_core.entry import program

strategy_server = program("magic_server.strategy_server")
magic = program("magic_bringup.client")
report = program("magic_bringup.report")
goal_times = program("magic_bringup.goal_times")
rgbd_to_bag = program("magic_bringup.rgbd_to_bag")
bridge = program("magic_bringup.bridge")
detected_objects = program("magic_bringup.detected_objects")
robot_model = program("magic_bringup.robot_model")
bag_player = program("magic_bags.bag_player")
bag_recorder = program("magic_bags.bag_recorder")
calibrate_cameras = program("magic_bringup.calibrate_cameras")
trials = program("magic_lab.trials")
reference = program("magic_bringup.reference")
