"""QoS profiles between rclpy and the ``rosbags`` library."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from rclpy.duration import Duration
from rclpy.qos import DurabilityPolicy, HistoryPolicy, LivelinessPolicy, QoSProfile, ReliabilityPolicy
from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime

#: Both libraries write "for ever" as the largest 64-bit number of nanoseconds.
FOREVER = 2**63 - 1


def offered(qos: Sequence[Qos], count: int) -> QoSProfile:
    """The profile to publish a recorded topic with, such that every subscriber that the original publishers satisfied is satisfied.

    ``count``: messages of the topic in the bag. Without a recorded profile it is reliable, volatile, keep last 10. Discovery does not tell
    a recorder the history depth, and a latched topic with several messages (``/tf_static``) needs them all kept: hence the lower bound.
    """
    if not qos:
        return QoSProfile(depth=10)
    latched = all(q.durability == QosDurability.TRANSIENT_LOCAL for q in qos)
    # One reliable publisher among best-effort ones: a reliable subscriber had matched that one only; offering reliable satisfies both.
    reliable = any(q.reliability not in (QosReliability.BEST_EFFORT, QosReliability.UNKNOWN) for q in qos)
    keep_all = all(q.history == QosHistory.KEEP_ALL for q in qos)
    depth = max(max(q.depth for q in qos), min(count, 1000) if latched else 10, 1)
    profile = QoSProfile(
        history=HistoryPolicy.KEEP_ALL if keep_all else HistoryPolicy.KEEP_LAST,
        depth=depth,
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
    )
    deadlines = [_nanoseconds(q.deadline) for q in qos]
    if all(0 < d < FOREVER for d in deadlines):
        profile.deadline = Duration(nanoseconds=max(deadlines))
    lifespans = [_nanoseconds(q.lifespan) for q in qos]
    if all(0 < d < FOREVER for d in lifespans):
        profile.lifespan = Duration(nanoseconds=max(lifespans))
    return profile


def requested(endpoints: Sequence[Any]) -> QoSProfile:
    """The profile that a recorder subscribes with: the strongest that every present publisher (``TopicEndpointInfo``) offers."""
    profiles = [e.qos_profile for e in endpoints]
    reliable = bool(profiles) and all(p.reliability == ReliabilityPolicy.RELIABLE for p in profiles)
    latched = bool(profiles) and all(p.durability == DurabilityPolicy.TRANSIENT_LOCAL for p in profiles)
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=1000 if latched else 100,
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
    )


def recorded(endpoints: Sequence[Any]) -> tuple[Qos, ...]:
    """The profiles that the present publishers offer, as a bag stores them."""
    return tuple(dict.fromkeys(_stored(e.qos_profile) for e in endpoints))


def _stored(profile: QoSProfile) -> Qos:
    reliabilities = {ReliabilityPolicy.RELIABLE: QosReliability.RELIABLE, ReliabilityPolicy.BEST_EFFORT: QosReliability.BEST_EFFORT}
    durabilities = {DurabilityPolicy.TRANSIENT_LOCAL: QosDurability.TRANSIENT_LOCAL, DurabilityPolicy.VOLATILE: QosDurability.VOLATILE}
    histories = {HistoryPolicy.KEEP_LAST: QosHistory.KEEP_LAST, HistoryPolicy.KEEP_ALL: QosHistory.KEEP_ALL}
    livelinesses = {LivelinessPolicy.AUTOMATIC: QosLiveliness.AUTOMATIC, LivelinessPolicy.MANUAL_BY_TOPIC: QosLiveliness.MANUAL_BY_TOPIC}
    return Qos(
        history=histories.get(profile.history, QosHistory.UNKNOWN),
        depth=profile.depth,
        reliability=reliabilities.get(profile.reliability, QosReliability.UNKNOWN),
        durability=durabilities.get(profile.durability, QosDurability.UNKNOWN),
        deadline=_time(profile.deadline),
        lifespan=_time(profile.lifespan),
        liveliness=livelinesses.get(profile.liveliness, QosLiveliness.UNKNOWN),
        liveliness_lease_duration=_time(profile.liveliness_lease_duration),
        avoid_ros_namespace_conventions=bool(profile.avoid_ros_namespace_conventions),
    )


def _time(duration: Duration) -> QosTime:
    nanoseconds = duration.nanoseconds or FOREVER
    return QosTime(*divmod(nanoseconds, 10**9))


def _nanoseconds(stored: QosTime) -> int:
    return min(stored.sec * 10**9 + stored.nsec, FOREVER)
