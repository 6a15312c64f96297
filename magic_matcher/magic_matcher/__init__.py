"""Contact analogies: from the contact point of one demonstration to the contact point on a new tool.

The pure modules import no rclpy: :mod:`contour` and :mod:`curvature` (the local stage),
:mod:`features`, :mod:`dinov2`, :mod:`embedded` and :mod:`global_matching` (the global
stage), :mod:`score`, and :mod:`matching`, which joins them.
"""
