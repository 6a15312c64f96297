"""A node with one of everything, for the tests of the ros2 command; run as a process of its own."""

import contextlib
import os
import signal
import sys
import time

import rclpy
from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor, SetParametersResult
from rclpy.action import ActionServer, CancelResponse
from rclpy.executors import MultiThreadedExecutor
from rclpy.lifecycle import LifecycleNode
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import Image
from std_msgs.msg import String
from std_srvs.srv import SetBool

from magic_interfaces.action import RunStrategy


class SmallNode(Node):
    def __init__(self) -> None:
        super().__init__("small")
        gain = ParameterDescriptor(description="of the loop", floating_point_range=[FloatingPointRange(from_value=-2.0, to_value=2.5)])
        self.declare_parameter("gain", 0.5, gain)
        self.declare_parameter("count", 3)
        odd = ParameterDescriptor(read_only=True, integer_range=[IntegerRange(from_value=1, to_value=9, step=2)])
        odd.additional_constraints = "no even number"
        self.declare_parameter("odd", 3, odd)
        self.declare_parameter("label", "one")
        self.declare_parameter("sizes", [1.0, 2.5])
        self.add_on_set_parameters_callback(self.check)
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self.latched = self.create_publisher(String, "latched", latched)
        self.latched.publish(String(data="kept"))
        self.image = self.create_publisher(Image, "image", 5)
        self.create_timer(0.05, lambda: self.image.publish(Image(height=2, width=100, encoding="mono8", step=100, data=bytes(200))))
        self.create_subscription(String, "heard", lambda m: print(f"heard {m.data}", flush=True), 10)
        self.create_service(SetBool, "switch", self.switch)
        self.server = ActionServer(self, RunStrategy, "work", self.work, cancel_callback=lambda _: CancelResponse.ACCEPT)

    def check(self, parameters: list) -> SetParametersResult:
        bad = [p for p in parameters if p.name == "gain" and p.value < 0]
        return SetParametersResult(successful=not bad, reason="gain is below 0" if bad else "")

    @staticmethod
    def switch(request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        response.success, response.message = request.data, "switched"
        return response

    @staticmethod
    def work(handle) -> RunStrategy.Result:
        deadline = time.monotonic() + (0.2 if handle.request.strategy == "short" else 60.0)
        handle.publish_feedback(RunStrategy.Feedback(stage="match", message="at work"))
        while time.monotonic() < deadline:
            if handle.is_cancel_requested:
                handle.canceled()
                return RunStrategy.Result(code=502, message="canceled")
            time.sleep(0.02)
        handle.succeed()
        return RunStrategy.Result(message=f"did {handle.request.strategy}")


def main() -> None:
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))
    rclpy.init()
    executor = MultiThreadedExecutor(3)
    nodes = SmallNode(), LifecycleNode("cycling")
    for node in nodes:
        executor.add_node(node)
    print("ready", flush=True)
    with contextlib.suppress(KeyboardInterrupt, rclpy.executors.ExternalShutdownException):
        executor.spin()
    executor.shutdown(timeout_sec=5.0)
    sys.stdout.flush()
    # The interpreter ends modules and nodes in no particular order, which has ended in a segmentation fault.
    os._exit(0)


if __name__ == "__main__":
    main()
