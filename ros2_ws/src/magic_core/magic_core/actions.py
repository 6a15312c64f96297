"""An action client that may be used from any thread while an executor spins in others."""

from __future__ import annotations

import threading
from typing import Any

import rclpy.action


class ActionClient(rclpy.action.ActionClient):
    """rclpy's client without its race (rclpy issue 1123): of every request, the answer may come before the request is noted.

    rclpy sends a request first and notes its number after that.  An executor in another thread that takes the answer in
    between finds a number that it does not know, says "Ignoring unexpected goal response", and the future never completes:
    about one call in a few hundred on a busy machine.  Here the sender holds a lock until the number is noted, and whoever
    handles answers waits for that.
    """

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        self._noting = threading.RLock()
        super().__init__(*args, **kwargs)

    def send_goal_async(self, *args: Any, **kwargs: Any) -> Any:
        """As rclpy's."""
        with self._noting:
            return super().send_goal_async(*args, **kwargs)

    def _cancel_goal_async(self, goal_handle: Any) -> Any:
        with self._noting:
            return super()._cancel_goal_async(goal_handle)

    def _get_result_async(self, goal_handle: Any) -> Any:
        with self._noting:
            return super()._get_result_async(goal_handle)

    def _remove_pending_request(self, future: Any, pending_requests: Any) -> Any:
        with self._noting:  # it walks through what senders add to
            return super()._remove_pending_request(future, pending_requests)

    async def execute(self, taken_data: Any) -> None:
        """As rclpy's."""
        with self._noting:
            pass  # the request that this answers was sent under the lock, and is noted by now
        await super().execute(taken_data)
