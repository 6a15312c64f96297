"""What each result code means and what its reader can do: for ``magic doctor`` and for the documents, in one place."""

from __future__ import annotations

from typing import NamedTuple

from magic_core.errors import Code


class Remedy(NamedTuple):
    """meaning: what has happened.  mend: what to do."""

    meaning: str
    mend: str


REMEDIES: dict[Code, Remedy] = {
    Code.OK: Remedy("Done.", "Nothing."),
    Code.NO_FRAMES: Remedy(
        "No image, or no joint state, has come.",
        "Look at `ros2 topic list` and `ros2 topic hz` for the topic in the message; start the driver, remap its names, compare ROS_DOMAIN_ID "
        "on both machines.",
    ),
    Code.NO_CAMERA_INFO: Remedy(
        "Images come, their intrinsics do not.",
        "Publish camera_info beside the image, with K filled in; drivers do so once the camera is calibrated.",
    ),
    Code.BAD_ENCODING: Remedy(
        "An image has another encoding than the node reads.",
        "Colour: rgb8, bgr8, rgba8, bgra8 or mono8. Depth: 16UC1 or 32FC1. Convert in the driver, or by image_proc.",
    ),
    Code.BAD_IMAGE: Remedy(
        "An image is broken, empty, or of another size than what belongs to it.",
        "Use colour and depth of one size and one moment: depth registered to colour.",
    ),
    Code.NO_DEPTH: Remedy(
        "Nearly no pixel has a depth.",
        "Look at the depth image: too near (below some 0.25 m), the emitter off, a covered lens, sunlight, glass.",
    ),
    Code.NO_TABLE: Remedy(
        "No level plane was found in the region of interest.",
        "Check the camera's pose (calibrate_cameras) and region_low, region_high: the table has to lie in that box, in the frame of the results.",
    ),
    Code.NO_OBJECTS: Remedy(
        "A table, and nothing on it.",
        "Put things into the region (region_low, region_high), at least 4 mm high; see that the arm does not hide them.",
    ),
    Code.STALE_DATA: Remedy(
        "What was planned for has moved, gone, or has not been seen since.",
        "Leave the scene alone while a run goes on; compare the clocks of the machines; play a bag with --loop, or with --clock and use_sim_time.",
    ),
    Code.BAD_INTRINSICS: Remedy(
        "fx, fy, cx, cy make no camera.", "Give those of the picture's own size, in pixels; calibrate the camera where the driver has none."
    ),
    Code.NO_TRANSFORM: Remedy(
        "TF does not lead from the camera to the frame of the results at the image's stamp.",
        "Publish the camera's pose (calibrate_cameras prints the command), or set extrinsics.CAMERA; check the frame names by `ros2 topic echo /tf_static`.",
    ),
    Code.RECONSTRUCTION_FAILED: Remedy(
        "A thing could not be closed to a solid.", "Move it so that the cameras see more of it; a second camera helps most."
    ),
    Code.BAD_BAG: Remedy(
        "A bag cannot be read, or holds no topic that is needed.",
        "`ros2 bag info BAG` shows what is in it; give other names by --topics, or record again.",
    ),
    Code.UNKNOWN_SEGMENTER: Remedy("No segmenter of that name.", "segmenter: depth, sam2 or sam."),
    Code.SEGMENTER_WEIGHTS: Remedy(
        "The weights of SAM or SAM 2 cannot be loaded.",
        "Name a hub id that can be reached or a local folder by `weights`; `segmenter: depth` needs none.",
    ),
    Code.CAMERAS_DISAGREE: Remedy(
        "Two cameras see one thing at two places, by more than 10 mm or 1.5 degrees.",
        "Calibrate them again (calibrate_cameras), or use one alone (`cameras`).",
    ),
    Code.TABLE_AMBIGUOUS: Remedy(
        "All large planes stand upright in the picture, and no pose of the camera is known.",
        "Give the camera's pose, or turn the camera so that the table faces up.",
    ),
    Code.ROBOT_NOT_THERE: Remedy(
        "A camera looks through the place where joint states and TF put the arm.",
        "Check the calibration and robot.base_frame; `self_filter: false` where there is no arm.",
    ),
    Code.SOMETHING_HANGS: Remedy(
        "Something hangs above the table that is no known thing: a hand, a cable, the arm itself.",
        "Take it away, or wait; let joint_states come, so that the arm is cut out.",
    ),
    Code.DEPTH_UNIT: Remedy(
        "Depth is no table-top's in the unit that it is read in.",
        "Set the driver's unit, or the parameter depth_unit (mm, 0.25mm, m, ...).",
    ),
    Code.ROBOT_ELSEWHERE: Remedy(
        "A camera sees the arm at another place than joint states and TF put it, by more than `arm_offset`.",
        "Calibrate the camera against the arm again (calibrate_cameras --on-hand); check robot.base_frame, and that the URDF is the arm's that is there.",
    ),
    Code.UNKNOWN_STRATEGY: Remedy("No strategy of that name, and no such folder.", "`ros2 run magic_bringup magic strategies` lists them."),
    Code.UNKNOWN_OBJECT: Remedy(
        "No object of that id, or none to choose from.",
        "`ros2 run magic_bringup magic objects` lists them; ids change when things are put elsewhere.",
    ),
    Code.BAD_REQUEST_IMAGE: Remedy("An image in a request cannot be used.", "See the message: encoding, size, mask of the same size."),
    Code.EMPTY_MASK: Remedy("A mask marks nearly nothing.", "Give a mask of at least 16 pixels, 4 wide, on the object."),
    Code.POINT_OUTSIDE: Remedy(
        "The reference point lies off the object's edge or off the picture.", "Give a pixel on the outline where the demonstration touched."
    ),
    Code.NO_MATCH: Remedy(
        "No place on the tools does what the demonstrated contact did.",
        "The number says what was lacking: curvature, room for the target, likeness. Try another tool; show the side that matters to the cameras.",
    ),
    Code.UNKNOWN_FEATURES: Remedy("No feature backend of that name.", "features: auto, embedded, dinov2, dift or sd_dino."),
    Code.FEATURE_WEIGHTS: Remedy(
        "The network's weights or device are not there.",
        "Name a hub id that can be reached or a local folder by `weights`, a device of this machine by `device`; `features: embedded` needs none.",
    ),
    Code.NO_CURVATURE: Remedy(
        "Too little outline around the contact to measure its curvature.",
        "Let the cameras see the contact's surroundings; move the point off a speck.",
    ),
    Code.BAD_STRATEGY: Remedy(
        "A strategy's folder is not complete or contradicts itself.",
        "The message names key and allowed values; `magic_core/strategy.py` documents them.",
    ),
    Code.OBJECT_CUT_OFF: Remedy(
        "The tool is seen in part: the picture's border, the region's, the arm or a thing in front cuts it off.",
        "Move it, or what hides it.",
    ),
    Code.AMBIGUOUS_OBJECT: Remedy(
        "The words for tool or target fit several objects, or none.",
        "Say more of it (colour, size, place), or give its id: the message lists what there is.",
    ),
    Code.HANDLE_NOT_SEEN: Remedy(
        "The demonstrated contact lies in a loop (a handle, a hook), and what was seen of the tool has none: it may be on the side that no camera saw, or its hole was not seen through.",
        "Turn the tool so that the handle stands out to the side of a camera; a second camera helps. The message says how much was not seen, and where.",
    ),
    Code.WAY_BLOCKED: Remedy(
        "Something stands where the target is to be led, whichever way the strategy allows.",
        "The message names it and where it stands: move it aside, name another target, or set the target where there is room. `turned_by` of the strategy says how far the way may be turned.",
    ),
    Code.BAD_MOTION: Remedy(
        "A pose, frame or table in the request is no rigid transform or plane.",
        "An error of who sends it: quaternions of length 1, finite numbers.",
    ),
    Code.UNKNOWN_VARIANT: Remedy("No such variant.", "variant: fg or arm."),
    Code.NO_GRASP: Remedy(
        "The gripper finds no hold that serves the whole motion.",
        "Check robot.opening against the tool's width; turn the tool so that a side stands free of the table; `fg` shows whether the motion itself is possible.",
    ),
    Code.NO_IK: Remedy(
        "The arm does not reach a pose of the motion, or only by a jump.", "Move tool and target nearer to the middle of the workspace."
    ),
    Code.START_IN_COLLISION: Remedy(
        "The arm touches something where it stands.",
        "Drive it clear; check the SRDF's pairs and the calibration: the message names the pair.",
    ),
    Code.PATH_IN_COLLISION: Remedy(
        "Something is in the way of arm, hand or tool.", "The message names the pair and the place: make room there."
    ),
    Code.JOINT_LIMIT: Remedy(
        "A joint would have to go beyond its limit.", "Turn or move tool and target; the message names joint and waypoint."
    ),
    Code.DYNAMIC_LIMIT: Remedy(
        "A torque, velocity or acceleration would exceed its limit.",
        "Lower velocity_scale or acceleration_scale; a lighter tool; nearer to the base.",
    ),
    Code.NO_PATH: Remedy(
        "No free way for the arm between two configurations was found in time.",
        "Make room around the arm; another seed; a longer plan timeout.",
    ),
    Code.TIME_PARAMETERISATION: Remedy(
        "The path has no timing within the limits.", "Lower the scales, or check velocity limits of the URDF and robot.acceleration."
    ),
    Code.BAD_MESH: Remedy(
        "An object's mesh is empty, not finite, or far too large.", "An error of who sends it; below a million triangles, in metres."
    ),
    Code.PLANNING_TIMEOUT: Remedy(
        "Planning did not end in its time.", "A longer plan_timeout; fewer things on the table; a less busy machine."
    ),
    Code.PRE_CONTACT_COLLISION: Remedy(
        "In simulation tool or arm hit something before the contact.",
        "Make room around the target; often a sign of a shape that was seen in part.",
    ),
    Code.LOST_CONTACT: Remedy(
        "In simulation the tool lost the target.", "Another tool or contact; more cameras; the target nearer to the robot."
    ),
    Code.DRIFT: Remedy("In simulation the target slid off to the side or turned away.", "Another contact; a target that stands freely."),
    Code.UNSTABLE: Remedy(
        "In simulation things did not come to rest, or flew off.", "Another contact; check the strategy's friction and density."
    ),
    Code.GOAL_NOT_REACHED: Remedy(
        "In simulation the motion ended without what the strategy's goal asks for.", "The metrics say by how much it was missed."
    ),
    Code.SIMULATION_EXPLODED: Remedy(
        "The simulation gave impossible numbers.", "Usually a broken mesh or a joint without limits; the message names the body."
    ),
    Code.SIMULATION_TIMEOUT: Remedy(
        "The rollouts did not end in their time.", "A longer verify_timeout; fewer rollouts; more workers; a less busy machine."
    ),
    Code.GRASP_SLIPPED: Remedy(
        "In simulation the tool slid in the gripper.",
        "A grasp nearer to the contact; check grip_force and finger_friction against the real gripper, and tool_mass against a scale.",
    ),
    Code.BAD_SCENE: Remedy(
        "The scene given to the verifier is not usable.", "An error of who sends it: finite poses, a table plane with a unit normal."
    ),
    Code.LIMIT_EXCEEDED: Remedy(
        "In simulation something was pressed, pushed or lagged more than is allowed.",
        "The message names what and where; parameters `limits.*` say how much.",
    ),
    Code.UNKNOWN_GOAL: Remedy(
        "The strategy's goal test is none that the verifier has.", "`goal.test` in strategy.yaml; the message lists the known ones."
    ),
    Code.NOT_SURE_ENOUGH: Remedy(
        "It often works in simulation, but not surely enough: the lower end of the interval is below required_rate.",
        "`failures` says what goes wrong and how often: mend that. More rollouts make the interval narrower.",
    ),
    Code.OBSTACLE_PUSHED: Remedy(
        "In simulation tool, target or arm push a thing that has no part in it.",
        "The message names it: move that thing aside, or the target where more room is. `limits.shove` says how far it may be moved.",
    ),
    Code.SERVER_UNAVAILABLE: Remedy(
        "A node that is needed is not there or has died.",
        "`ros2 run magic_bringup magic doctor` names it and how to start it; its own output says why it ended.",
    ),
    Code.SERVER_TIMEOUT: Remedy(
        "A node did not answer in its time.", "A longer timeout; see whether the machine is out of memory or busy."
    ),
    Code.CANCELED: Remedy("Somebody cancelled it.", "Send the goal again."),
    Code.NO_CANDIDATE_SUCCEEDED: Remedy(
        "Every candidate was dropped, each with its reason.",
        "Read the reasons (`dropped` lines, the report's table); more candidates by top_k.",
    ),
    Code.BUSY: Remedy("The server is at another goal.", "Wait for it or cancel it; one goal at a time."),
    Code.NOT_VERIFIABLE: Remedy(
        "The strategy says that simulation cannot judge it.",
        "Its motion is returned and marked unverified; the goal's allow_unverified accepts that.",
    ),
    Code.BAD_REQUEST: Remedy(
        "A parameter, argument or file is not what is allowed.", "The message says which, its value and what is allowed."
    ),
    Code.EXECUTION_FAILED: Remedy(
        "Arm or gripper reported an error; the arm stands where it stopped.",
        "See the controller's own output; drive the arm clear by hand before the next run. Begin with `speed: 0.1`.",
    ),
    Code.GRASP_FAILED: Remedy(
        "The fingers closed on more or less than the tool's width.",
        "The tool slipped or was elsewhere: look at the scene; check finger_scale, squeeze, grasp_tolerance.",
    ),
    Code.NOT_ALONE: Remedy(
        "Two servers of one kind are there: whose answer counts cannot be told.",
        "End all but one (`ros2 node list`); another ROS_DOMAIN_ID for each setup.",
    ),
    Code.SCENE_CHANGED: Remedy(
        "Target or obstacles moved, or something came in, while the arm was at work; it was stopped, and no further plan was allowed or found.",
        "Keep the scene still, or raise loop.replans; loop.watch_tolerance says how much is a move, loop.intrusion how near something may come.",
    ),
    Code.TOOL_SLIPPED: Remedy(
        "The tool is off in the hand, by more than is allowed or than a plan could be made for; the arm stands with it.",
        "Take the tool out of the hand; more effort, softer pads, a grasp nearer to its middle. loop.slip_shift and loop.slip_turn are the limits.",
    ),
    Code.GOAL_MISSED: Remedy(
        "Carried out, but by what cameras see afterwards the goal is not met, and no further try was allowed or found.",
        "The message says what was measured; loop.executions allows more tries. Compare friction and densities of the strategy with the real things.",
    ),
    Code.GOAL_UNSEEN: Remedy(
        "Carried out, but whether the goal is met cannot be told by what cameras see.",
        "Look for yourself; another camera, or a larger region (region_low, region_high), where the message says that something is not seen; "
        "loop.judge: false asks no such thing.",
    ),
    Code.ARM_NOT_AT_REST: Remedy(
        "The arm was told to stop and is not known to stand.",
        "Look at the arm first. Its controller may not honour a cancel, or joint_states are late or silent; loop.rest_time is the time given.",
    ),
    Code.TOOL_WEIGHT: Remedy(
        "By the arm's torques the tool weighs something else than its motion was verified with, and no motion passed with what it weighs; the arm stands with it.",
        "Take the tool out of the hand, weigh it and give tool_mass; loop.torque_error: 0 where the arm's efforts are no measured torques.",
    ),
    Code.INTERNAL: Remedy("A defect of this software.", "Please report it with the node's output: it holds the traceback."),
}
