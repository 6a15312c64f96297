"""A demonstration that needs no files of other packages."""

import numpy as np
import pytest

from magic_core import shapes, strategy
from magic_core.contact import Contact, contact_frame
from magic_matcher import global_stage


@pytest.fixture(scope="session")
def demonstration():
    """A strategy: a hook lying flat pulls a standing cylinder of 25 mm radius towards -x."""
    hook, cylinder = shapes.make("l_hook", 1), shapes.make("cylinder", 1, radius=0.025)
    tool_view, target_view = hook.view(), cylinder.view()
    point, normal = np.array([345.0, 191.5]), np.array([1.0, 0.0])
    return strategy.Strategy(
        name="test",
        description="pull a cylinder with a hook",
        view="top",
        mode="plan",
        tool_view=tool_view,
        tool_contact=hook.contact("inner", tool_view),
        target_view=target_view,
        target_contact=Contact(point, normal, 0.025, False, 0.04, contact_frame(target_view, point, normal)),
        target_normal=np.array([1.0, 0, 0]),
        target_view_direction=np.array([0.0, 0, -1]),
        times=np.array([0.0]),
        target_from_tool=np.eye(4)[None],
        tool_mesh=hook.mesh,
        target_mesh=cylinder.mesh,
        waypoints=(),
        goal=strategy.Goal("hook"),
        physics=strategy.Physics(),
    )


@pytest.fixture(scope="session")
def reference():
    """The inner side of an L hook's bend, as the global stage sees it."""
    shape = shapes.make("l_hook", 3)
    view = shape.view()
    contact = shape.contact("inner", view)
    return global_stage.make_reference(view, contact.pixel, contact.normal)
