"""From one demonstration's contact to ranked contacts on new tools (paper, section III).

:class:`Matcher` joins the stages: the backend proposes places (global), curvature
refines each (local), the score ranks them, for one tool or for several, with the
contact on the target that each would meet.
"""

from __future__ import annotations

import itertools
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magic_core import transforms
from magic_core.contact import Companion, Contact, ContactCandidate, contact_frame, turned_over
from magic_core.content import digest
from magic_core.errors import Code, MagicError
from magic_core.placement import Relative, placement, relative
from magic_core.placement import mirrored as mirrored_place
from magic_core.recent import Recent
from magic_core.scene import CanonicalView, SceneObject
from magic_core.strategy import Strategy
from magic_core.surface import Surface
from magic_core.views import mirrored
from magic_matcher import contour as contours
from magic_matcher import curvature, enclosing, facing, global_stage, holding, score
from magic_matcher.candidates import heatmap_seen_from, on_surface, seen_from, squared, to_contact
from magic_matcher.contour import Contour
from magic_matcher.embedded import EmbeddedFeatures
from magic_matcher.global_stage import Features, Proposal, Reference
from magic_matcher.plausible import Demands, Refusal, demands, lesser, refusals, room_for
from magic_matcher.selection import choose_target, select
from magic_matcher.targets import Target, contact_on, target_view
from magic_matcher.tools import Tool, tool_of

#: Proposals looked at for each candidate that is asked for: the local stage may merge or re-rank them; and those looked at where
#: all of these are refused.
OVERSAMPLING, RESERVE = 2, 5
#: Two candidates nearer than this share of the tool's size are the same place.
SAME_PLACE = 0.06
#: Places of a further contact that are tried with each of the first.
COMPANIONS = 8
#: Places of a target that are looked at where it is met at a feature.
FEATURES = 8
#: Bytes of the pictures of targets that are kept: some fifteen.
DRAWN = 16 * 2**20
#: By so much a match in another view must be better for the tool to be turned for it.
WORTH_TURNING = 0.05
#: A tool that is turned by so much (rad) for a place is held and led another way; one that need not be turned at all by so much.
ANOTHER_WAY, PRESENT_WAY = np.deg2rad(45.0), np.deg2rad(5.0)


@dataclass(frozen=True)
class MatchResult:
    """What a match found.

    Attributes
    ----------
    candidates : best first, of all tools together.
    heatmap : (H, W) float32 0..1 over the view of the best candidate's tool; ``None`` unless asked for.
    views : the view in which its best candidates were found, for each tool id; :func:`magic_core.views.view_of_contact` gives the view of
        each.
    target_id : empty where the target came as a view or there was none.
    features : the backend's name.
    seconds : by the clock.
    refused : why other tools have no candidate.
    """

    candidates: tuple[ContactCandidate, ...]
    heatmap: NDArray[np.float32] | None
    views: dict[str, CanonicalView]
    target_id: str
    features: str
    seconds: float
    target_view: CanonicalView | None = None
    refused: tuple[str, ...] = ()


@dataclass(frozen=True)
class Further:
    """A further contact of a reference: its name, the place in the reference's view, its contact, and the radius (m) that the target has
    there."""

    name: str
    reference: Reference
    contact: Contact
    target_radius: float | None


def further_of(strategy: Strategy) -> tuple[Further, ...]:
    """The references of a strategy's contacts after the first."""
    found = []
    for pair in strategy.contacts:
        alone = replace(strategy, tool_contact=pair.tool, target_contact=pair.target)
        found.append(Further(pair.name, global_stage.from_strategy(alone), pair.tool, pair.target.disc_radius))
    return tuple(found)


@dataclass
class Matcher:
    """Both stages with one backend.

    weight is lambda; two_step=False leaves out the second curvature estimate and the
    convexity search (the paper's ablation).  What the backend prepared of a reference is
    kept, in memory and, with ``cache`` (a :class:`magic_matcher.cache.Cache`), on disk.
    """

    backend: Features
    weight: float = score.LAMBDA
    two_step: bool = True
    cache: Any = None
    _prepared: dict[str, Any] = field(default_factory=dict, repr=False)
    _drawn: Recent[bytes, CanonicalView] = field(default_factory=lambda: Recent(DRAWN), repr=False, compare=False)
    _lock: Any = field(default_factory=threading.Lock, repr=False, compare=False)
    _drawing: Any = field(default_factory=threading.Lock, repr=False, compare=False)

    def prepare(self, reference: Reference) -> Any:
        """The backend's view of a reference, computed once."""
        key = f"{self.backend.key()}-{reference.key()}"
        found = self._prepared.get(key)
        if found is not None:
            return found
        # Of requests that come together one prepares a new reference, the others wait for it.
        with self._lock:
            if key not in self._prepared:
                if len(self._prepared) >= 16:  # memory stays flat over any number of different references
                    self._prepared.pop(next(iter(self._prepared)))

                def make() -> Any:
                    return self.backend.prepare(reference)

                self._prepared[key] = make() if self.cache is None else self.cache.get(key, make)
            return self._prepared[key]

    def match(
        self,
        strategy: Strategy,
        tools: Sequence[SceneObject | Tool],
        target: SceneObject | CanonicalView | None = None,
        top_k: int = 3,
        heatmap: bool = False,
    ) -> MatchResult:
        """Ranked contacts on the tools: at most ``top_k`` a tool, all tools' together, best first.

        target as a view alone stands in the pose of its view frame's object (the object frame is taken for the world).
        """
        start = time.perf_counter()
        drawn: list[Tool] = []
        unseen: list[MagicError] = []
        for item in tools:
            try:
                drawn.append(item if isinstance(item, Tool) else tool_of(item, strategy.view))
            except MagicError as error:  # a mesh that cannot be drawn is no reason to leave out the others
                unseen.append(MagicError(error.code, f"{item.id}: {error.message}"))
        if unseen and not drawn:
            raise unseen[0]
        met: Target | None = None
        if isinstance(target, SceneObject):
            met = self.target_of(target, strategy)
        elif target is not None:
            met = Target("", target, *self._contacts_on(target, strategy, np.eye(4)))
        reference = global_stage.from_strategy(strategy)
        further = further_of(strategy)
        found = self.match_views(
            reference, strategy.tool_contact, drawn, met, top_k, heatmap, strategy.target_contact.disc_radius, start, further
        )
        return replace(found, refused=(*found.refused, *(error.message for error in unseen)))

    def match_views(
        self,
        reference: Reference,
        reference_contact: Contact,
        tools: Sequence[Tool],
        target: Target | None,
        top_k: int = 3,
        heatmap: bool = False,
        reference_target_radius: float | None = None,
        start: float | None = None,
        further: Sequence[Further] = (),
    ) -> MatchResult:
        """As :meth:`match`, from a reference and views; reference_target_radius r(p_O) in metres; further: contacts that belong to it."""
        start = time.perf_counter() if start is None else start
        if top_k < 1:
            raise MagicError(Code.BAD_REQUEST, "top_k", top_k, "1 or more")
        if not tools:
            raise MagicError(Code.UNKNOWN_OBJECT, "tools", "none", "at least one object besides the target")
        if target is not None and len(target.further) != len(further):
            raise MagicError(
                Code.BAD_REQUEST, "contacts on the target", 1 + len(target.further), f"{1 + len(further)}, those of the strategy"
            )

        task = self._task(reference, reference_contact, target, reference_target_radius, top_k, heatmap)
        if further:
            places = [None] * len(further) if target is None else [replace(target, contact=c, further=()) for c in target.further]
            tasks = [
                (one.name, self._task(one.reference, one.contact, met, one.target_radius, top_k))
                for one, met in zip(further, places, strict=True)
            ]
            task = replace(task, further=tuple(tasks))
        found: list[tuple[ContactCandidate, NDArray[np.float32] | None]] = []
        views: dict[str, CanonicalView] = {}
        failures: list[MagicError] = []
        for tool in tools:
            try:
                seen = self._seen_best(task, tool)
                views[tool.id] = seen.view
                found.extend((candidate, seen.heatmap) for candidate in seen.candidates)
            except MagicError as error:
                views[tool.id] = tool.told_in or tool.view
                failures.append(error)
        if not found:
            if len(failures) == 1:
                raise failures[0]
            # Where a side that was not seen may hold the place, showing it comes before looking for another tool.
            code = Code.HANDLE_NOT_SEEN if any(f.code is Code.HANDLE_NOT_SEEN for f in failures) else Code.NO_MATCH
            raise MagicError(code, "no tool has a place like the demonstrated contact: " + "; ".join(f.message for f in failures))
        found.sort(key=lambda pair: -pair[0].score)
        return MatchResult(
            candidates=tuple(candidate for candidate, _ in found),
            heatmap=found[0][1],
            views=views,
            target_id=target.id if target is not None else "",
            features=self.backend.name,
            seconds=time.perf_counter() - start,
            target_view=target.view if target is not None else None,
            refused=tuple(failure.message for failure in failures),
        )

    def _task(
        self, reference: Reference, contact: Contact, target: Target | None, radius: float | None, top_k: int, heatmap: bool = False
    ) -> _Task:
        prepared = self.prepare(reference)
        # The radius of the disc that the tool is to hold; what is flat, sharp or met inside is no disc.
        disc = None if target is None else target.contact.disc_radius
        use_target = disc is not None and radius is not None
        scale = radius if use_target else reference.contour.size * reference.view.metres_per_pixel
        ratio = reference.radius * reference.view.metres_per_pixel / scale
        asked = demands(reference, self.backend.floor)
        side = None if np.isfinite(contact.radius) else facing.ends(reference.contour, reference.pixel, reference.normal)
        return _Task(reference, contact, prepared, asked, ratio, target, disc, use_target, top_k, heatmap, side=side)

    def feature_of(self, strategy: Strategy, view: CanonicalView, direction: NDArray[np.float64]) -> Contact:
        """p_O' by analogy: the place on a target that looks most as the demonstrated one does at p_O, of those that face a picture
        direction (2,).

        Raises ``NO_MATCH`` where none faces it.
        """
        shown = strategy.target_contact
        reference = global_stage.make_reference(strategy.target_view, shown.pixel, shown.normal)
        task = self._task(reference, shown, None, None, FEATURES)
        seen = self._in_view(task, Tool("the target", view), view)
        looking = [c for c in seen.candidates if float(c.tool.normal @ direction) > np.cos(facing.FACING)]
        if not looking:
            if not seen.candidates:
                raise _no_match("the target", seen.refusal)
            off = min(np.degrees(np.arccos(np.clip(float(c.tool.normal @ direction), -1, 1))) for c in seen.candidates)
            allowed = f"at most {np.degrees(facing.FACING):.0f} degrees"
            raise MagicError(
                Code.NO_MATCH, "angle of the target's likest places to the strategy's target normal", f"{off:.0f} degrees", allowed
            )
        return max(looking, key=lambda c: c.score).tool

    def target_view(self, item: SceneObject, strategy: Strategy) -> CanonicalView:
        """As the function of that name; what was drawn lately is not drawn again: it is looked at to choose the target, and when it is
        chosen."""
        key = digest((item.mesh, item.world_from_object, strategy.target_view_direction, strategy.target_outline, strategy.view))
        with self._drawing:
            view = self._drawn.get(key)
        if view is None:
            view = target_view(item, strategy)
            with self._drawing:
                if self._drawn.get(key) is None:
                    self._drawn.put(key, view, view.image.nbytes + view.mask.nbytes + (0 if view.depth is None else view.depth.nbytes))
        return view

    def target_of(self, item: SceneObject, strategy: Strategy) -> Target:
        """An object as the target of a strategy: its view, and where on it the strategy's contacts are."""
        view = self.target_view(item, strategy)
        return Target(item.id, view, *self._contacts_on(view, strategy, item.world_from_object))

    def _contacts_on(
        self, view: CanonicalView, strategy: Strategy, world_from_object: NDArray[np.float64]
    ) -> tuple[Contact, tuple[Contact, ...]]:
        further = (
            replace(strategy, target_normal=pair.target_normal, target_outline=pair.target_outline, target_contact=pair.target)
            for pair in strategy.contacts
        )
        first = contact_on(strategy, view, world_from_object, self.feature_of)
        return first, tuple(contact_on(one, view, world_from_object, self.feature_of) for one in further)

    def _seen_best(self, task: _Task, tool: Tool) -> _Seen:
        """The tool's candidates: those of the one of its views that shows the contact best, then those of its other views.

        The view as the tool stands is taken where the match in it is clear, or where no other is better by enough to turn the tool;
        if it is askew, only where no other shows a contact.  What other views show comes after all that the best one shows, as what
        has to be turned for the one may be in no hand's reach.  Where these are few, and a simulation can judge what is tried, places that
        show less (:func:`magic_matcher.plausible.lesser`) come after them.  Raises NO_MATCH with what the best place of all views lacks,
        HANDLE_NOT_SEEN where a loop is asked for, none shows, and a part of the tool large enough for one was not seen.
        """
        failures: list[tuple[float, MagicError]] = []
        looked: list[CanonicalView] = []

        def look(view: CanonicalView, asked: Demands) -> _Seen | None:
            looked.append(view)
            try:
                seen = self._in_view(task, tool, view, asked)
            except MagicError as error:
                failures.append((-1.0, error))
                return None
            if not seen.candidates:
                failures.append((seen.refusal.similarity if seen.refusal is not None else -1.0, _no_match(tool.id, seen.refusal)))
                return None
            return seen

        present = None if tool.askew else look(tool.view, task.asked)
        if present is not None and max(c.s_dino for c in present.candidates) >= self.backend.clear:
            return _told(task, tool, present)
        others = tool.others()
        seen = [found for view in others if (found := look(view, task.asked)) is not None]
        if tool.askew and not seen:
            present = look(tool.view, task.asked)
        if present is not None:
            seen.append(present)
        seen.sort(key=lambda s: -s.candidates[0].score - (WORTH_TURNING if s is present else 0.0))
        # A loop that was not seen is asked for (HANDLE_NOT_SEEN) and not made do without.
        judged = tool.mesh is not None and not task.asked.loop and not task.further
        if judged and sum(len(s.candidates) for s in seen) < task.top_k:
            less = [found for view in others if (found := look(view, lesser(task.asked))) is not None]
            if not tool.askew or not (seen or less):
                found = look(tool.view, lesser(task.asked))
                less += [] if found is None else [found]
            seen += sorted(less, key=lambda s: -s.candidates[0].score)
        # Where what is seen of a tool is all of it, it is held by what no place looks like, too: between its parts.
        whole = tool.mesh is not None and not task.further and (judged or 1.0 - tool.seen_share < enclosing.UNSEEN)
        if whole and sum(len(s.candidates) for s in seen) < task.top_k:
            between = [held for view in (*others, tool.view) if (held := self._between(task, tool, view)).candidates]
            seen += sorted(between, key=lambda s: -s.candidates[0].score)
        if not seen:
            error = max(failures, key=lambda failure: failure[0])[1]
            raise _not_seen(task, tool, looked, error) or error
        told = [_told(task, tool, one) for one in seen]
        near = 0.0 if tool.mesh is None else SAME_PLACE * float(tool.mesh.extents.max())
        rest = [(one, before.view is tool.view and not tool.askew) for one, before in zip(told[1:], seen[1:], strict=True)]
        return replace(told[0], candidates=[*told[0].candidates, *_further(told[0], rest, near, task.top_k)])

    def _in_view(self, task: _Task, tool: Tool, view: CanonicalView, asked: Demands | None = None) -> _Seen:
        """The best different places of one view that can stand in for the contact; asked: what they have to show, by default the task's."""
        contour = contours.extract(view.mask)
        radius = None if task.disc is None else task.disc / view.metres_per_pixel
        proposals = self.backend.propose(task.prepared, view, contour, radius, RESERVE * task.top_k, task.heatmap)
        # Which of several places is best together with others is not known before these: all are looked at.
        first = len(proposals.proposals) if task.further else OVERSAMPLING * task.top_k
        refused: list[Refusal] = []
        for some in (proposals.proposals[:first], proposals.proposals[first:]):
            candidates, why = self._refine(task, tool, view, contour, radius, some, asked)
            refused += why
            if candidates:
                break
        if task.further and candidates:
            candidates, why = self._joined(task, tool, view, contour, candidates)
            refused += why
        points = np.array([c.tool.pixel for c in candidates]).reshape(-1, 2)
        order = global_stage.suppress(points, np.array([c.score for c in candidates]), SAME_PLACE * contour.size, task.top_k)
        worst = max(refused, key=lambda r: r.similarity, default=None)
        return _Seen(view, [candidates[i] for i in order], worst, proposals.heatmap)

    def _between(self, task: _Task, tool: Tool, view: CanonicalView) -> _Seen:
        """The pockets of a view in which the target is held deep enough (:func:`magic_matcher.holding.pockets`).

        The contact is on the disc, towards the tool: between the arms of a V there is nothing of the tool at that point.  Likeness is not
        asked, so that they come after all places that have it.
        """
        hollow = lesser(task.asked).hollow
        if task.disc is None or hollow is None:
            return _Seen(view, [], None, None)
        contour, radius = contours.extract(view.mask), task.disc / view.metres_per_pixel
        curves = holding.centres(holding.room(contour, radius), radius)
        scale = task.disc if task.use_target else contour.size * view.metres_per_pixel
        s_curv = score.curvature_score(task.ratio, task.disc / scale)
        candidates = []
        for pocket in holding.pockets(contour, radius, curves, hollow, task.asked.hangs)[: task.top_k]:
            if tool.hides(view, pocket.out):
                continue
            pixel = pocket.centre - radius * pocket.out
            contact = Contact(pixel, pocket.out, task.disc, True, curvature.ALPHA * task.disc, contact_frame(view, pixel, pocket.out))
            candidates.append(
                ContactCandidate(
                    tool_id=tool.id,
                    tool=contact,
                    target=task.target.contact if task.target is not None else None,
                    rotation=global_stage.rotation_between(task.reference.normal, contact.normal, False),
                    flipped=False,
                    s_dino=0.0,
                    s_curv=s_curv,
                    score=score.combine(0.0, s_curv, self.weight),
                    tool_from_reference=contact.object_from_contact @ transforms.inverse(task.reference_contact.object_from_contact),
                )
            )
        return _Seen(view, candidates, None, None)

    def _joined(
        self, task: _Task, tool: Tool, view: CanonicalView, contour: Contour, candidates: list[ContactCandidate]
    ) -> tuple[list[ContactCandidate], list[Refusal]]:
        """Each candidate with the further contacts that suit it best as one rigid tool, its score that of all together; and why there are
        none.

        The score is the mean of all contacts' times how well they agree (:mod:`magic_core.placement`).  Where the demonstrated contact is
        straight, what was found is the straight side that is there.
        """
        candidates = [squared(view, contour, candidate, task.reference_contact) for candidate in candidates]
        sizes = task.reference.contour.size * task.reference.view.metres_per_pixel, contour.size * view.metres_per_pixel
        wanted = [
            relative(task.reference_contact.object_from_contact, one.reference_contact.object_from_contact) for _, one in task.further
        ]
        choices: list[list[ContactCandidate]] = []
        for name, one in task.further:
            radius = None if one.disc is None else one.disc / view.metres_per_pixel
            proposals = self.backend.propose(one.prepared, view, contour, radius, RESERVE * task.top_k)
            found, why = self._refine(one, tool, view, contour, radius, proposals.proposals)
            if not found:
                return [], [replace(refusal, what=f"{name}: {refusal.what}") for refusal in why]
            points = np.array([c.tool.pixel for c in found])
            order = global_stage.suppress(points, np.array([c.score for c in found]), SAME_PLACE * contour.size, COMPANIONS)
            choices.append([squared(view, contour, found[i], one.reference_contact) for i in order])
        joined = []
        for candidate in candidates:
            frame = candidate.tool.object_from_contact

            def seen(other: ContactCandidate, frame: NDArray[np.float64] = frame, over: bool = candidate.flipped) -> Relative:
                place = relative(frame, other.tool.object_from_contact)
                return mirrored_place(place) if over else place

            best, chosen = -1.0, ()
            for others in itertools.product(*choices):
                agreed = placement(wanted, [seen(other) for other in others], sizes).agreement
                score = agreed * float(np.mean([candidate.score, *(other.score for other in others)]))
                if score > best:
                    best, chosen = score, others
            companions = tuple(Companion(name, c.tool, c.target) for (name, _), c in zip(task.further, chosen, strict=True))
            joined.append(replace(candidate, score=best, companions=companions))
        return joined, []

    def _refine(
        self,
        task: _Task,
        tool: Tool,
        view: CanonicalView,
        contour: Contour,
        radius: float | None,
        proposals: Sequence[Proposal],
        asked: Demands | None = None,
    ) -> tuple[list[ContactCandidate], list[Refusal]]:
        """The local stage on proposals and the score of those that can stand in for the contact; why the others cannot."""
        reference, target = task.reference, task.target
        scale = task.disc if task.use_target else contour.size * view.metres_per_pixel
        starts = np.array([contour.nearest(proposal.pixel) for proposal in proposals], dtype=int)
        estimates = curvature.estimate_many(contour, starts, reference.concave, two_step=self.two_step)
        pairs = [(p, e) for p, e in zip(proposals, estimates, strict=True) if e is not None]
        if not pairs:
            return [], []
        around = room_for(task.asked, contour, radius)
        if around is not None and radius is not None and task.asked.hollow is not None:
            curves = holding.centres(around, radius)
            floor = (asked or task.asked).floor  # a place that shows less is held no less surely
            pairs = [(p, _steadied(task.asked, floor, contour, p, e, radius, curves)) for p, e in pairs]
        refused = refusals(
            asked or task.asked,
            contour,
            np.array([e.point for _, e in pairs]),
            np.array([e.normal for _, e in pairs]),
            np.array([e.concave for _, e in pairs]),
            np.array([p.similarity for p, _ in pairs]),
            radius,
            view.metres_per_pixel,
            around,
        )
        for i, (proposal, local) in enumerate(pairs):
            if refused[i] is None and tool.hides(view, local.normal):
                refused[i] = Refusal("side of the tool", "the one it lies on", "one that a camera can have seen", proposal.similarity)
        candidates: list[ContactCandidate] = []
        for (proposal, local), refusal in zip(pairs, refused, strict=True):
            if refusal is not None:
                continue
            contact = to_contact(view, _in_proportion(task, view, contour, proposal, local))
            s_curv = score.curvature_score(task.ratio, contact.radius / scale, contact.concave == reference.concave)
            frame = turned_over(contact.object_from_contact) if proposal.flipped else contact.object_from_contact
            candidates.append(
                ContactCandidate(
                    tool_id=tool.id,
                    tool=contact,
                    target=target.contact if target is not None else None,
                    rotation=global_stage.rotation_between(reference.normal, contact.normal, proposal.flipped),
                    flipped=proposal.flipped,
                    s_dino=proposal.similarity,
                    s_curv=s_curv,
                    score=score.combine(proposal.similarity, s_curv, self.weight),
                    tool_from_reference=frame @ transforms.inverse(task.reference_contact.object_from_contact),
                )
            )
        return candidates, [refusal for refusal in refused if refusal is not None]


@dataclass(frozen=True)
class _Task:
    """What is looked for in every view of every tool; ratio: r(p_T) / r(p_O); disc: radius (m) of the disc that stands for the target, if
    one does;
    further: the same for further contacts, by name; side: where the reference is on its straight side, if it is on one."""

    reference: Reference
    reference_contact: Contact
    prepared: Any
    asked: Demands
    ratio: float
    target: Target | None
    disc: float | None
    use_target: bool
    top_k: int
    heatmap: bool
    further: tuple[tuple[str, _Task], ...] = ()
    side: facing.Ends | None = None


@dataclass(frozen=True)
class _Seen:
    """A tool in one view: its candidates, best first, and why the most similar of the refused places was refused."""

    view: CanonicalView
    candidates: list[ContactCandidate]
    refusal: Refusal | None
    heatmap: NDArray[np.float32] | None


def _in_proportion(task: _Task, view: CanonicalView, contour: Contour, proposal: Proposal, found: curvature.Estimate) -> curvature.Estimate:
    """An estimate for a straight reference, moved along the straight side that it is on to where the reference is on its own: no place of a
    straight side looks different from the next, so that the features find any of them."""
    if task.side is None or task.further:
        return found
    side = facing.ends(contour, found.point, found.normal)
    if side is None:
        return found
    scale = task.reference.view.metres_per_pixel / view.metres_per_pixel
    return replace(found, point=side.like(task.side, proposal.flipped, scale))


def _steadied(
    asked: Demands, floor: float, contour: Contour, proposal: Proposal, found: curvature.Estimate, radius: float, curves: holding.Curves
) -> curvature.Estimate:
    """An estimate whose place and normal are those by which the target is held surely, where a hollow is asked for
    (:func:`holding.steadied`) and the place is similar enough (``floor``)."""
    if asked.hollow is None or found.concave != asked.concave or not proposal.similarity >= floor:
        return found
    held = holding.steadied(contour, found.point, found.normal, radius, curves, asked.hollow, asked.straight)
    return found if held is None else replace(found, point=held[0], normal=held[1])


def _further(best: _Seen, others: Sequence[tuple[_Seen, bool]], near: float, count: int) -> list[ContactCandidate]:
    """Candidates of other views, in their order, that make up those of the best view to ``count``; none promises more than those before it.

    A place within ``near`` metres of one that there is already is another candidate only if the tool is held another way for it; with each
    view: whether it is the present one, for which the tool need not be turned at all, so that a little askew is another way.
    """
    least = min(c.score for c in best.candidates)
    found, more = list(best.candidates), []
    for candidate, another in ((c, PRESENT_WAY if present else ANOTHER_WAY) for one, present in others for c in one.candidates):
        frame = candidate.tool.object_from_contact
        known = (c.tool.object_from_contact for c in found)
        if len(found) < count and not any(
            np.linalg.norm(frame[:3, 3] - k[:3, 3]) < near and abs(frame[:3, 2] @ k[:3, 2]) > np.cos(another) for k in known
        ):
            found.append(candidate)
            least = min(least, candidate.score)
            more.append(replace(candidate, score=least))
    return more


def _told(task: _Task, tool: Tool, seen: _Seen) -> _Seen:
    """What was found in one view of a tool, on the surface of its mesh, and told in the view in which it is wanted.

    That is, where the tool says nothing else, the view itself, of one and its opposite that which looks down, of level ones along -y, then
    -x: a view of the tool's own shape is looked at from the side that turns with it, while how it is to be held follows from which face is
    up.
    """
    if tool.mesh is None:
        return seen
    before, reference, surface = seen.view, task.reference_contact, Surface(tool.mesh)
    seen = replace(seen, candidates=[on_surface(surface, before, reference, c) for c in seen.candidates])
    view = before
    if before is tool.view and tool.told_in is not None:
        view = tool.told_in
    elif next((v for v in before.direction[::-1] if abs(v) > 1e-6), -1.0) > 0:
        view = mirrored(before)
    if view is before:
        return seen
    told = [seen_from(c, before, view, task.reference.normal, reference) for c in seen.candidates]
    heatmap = None if seen.heatmap is None else heatmap_seen_from(seen.heatmap, before, view)
    return replace(seen, view=view, candidates=told, heatmap=heatmap)


def _no_match(tool_id: str, refusal: Refusal | None) -> MagicError:
    name = tool_id or "the tool"
    if refusal is None:
        return MagicError(Code.NO_MATCH, f"usable contacts on {name}", 0, "a tool with an edge of at least 5 points to fit")
    what = f"{name}: {refusal.what} at its best place (similarity {refusal.similarity:.3f})"
    return MagicError(Code.NO_MATCH, f"{what}: {refusal.value} (allowed: {refusal.allowed})")


def _not_seen(task: _Task, tool: Tool, looked: Sequence[CanonicalView], error: MagicError) -> MagicError | None:
    """That a tool without a match may have its loop on a side that no camera saw; ``None`` where that cannot be the reason.

    looked: the views of it that were looked at; error: what its best place lacks.
    """
    unseen = 1.0 - tool.seen_share
    if not task.asked.loop or error.code is not Code.NO_MATCH or not unseen >= enclosing.UNSEEN:
        return None
    most = max((enclosing.most(contours.extract(view.mask)) for view in looked), default=0.0)
    if most >= enclosing.LOOP:
        return None
    side = tool.unseen_side()
    where = "" if side is None else f", most of it towards ({side[0]:.1f}, {side[1]:.1f}) in x and y"
    name = tool.id or "the tool"
    return MagicError(
        Code.HANDLE_NOT_SEEN,
        f"{name}: the demonstrated contact lies in a loop, and what was seen of {name} has neither hole nor hook; "
        f"no camera saw {100 * unseen:.0f} % of its surface{where}; else {error.message}",
    )


def target_contact(
    strategy: Strategy, view: CanonicalView, world_from_object: NDArray[np.float64], matcher: Matcher | None = None
) -> Contact:
    """p_O' (:func:`magic_matcher.targets.contact_on`); where a strategy meets its target at a feature, with the matcher's features, by
    default those that ship."""
    return contact_on(strategy, view, world_from_object, (matcher or Matcher(EmbeddedFeatures())).feature_of)


def match(
    strategy: Strategy,
    tools: Sequence[SceneObject | Tool],
    target: SceneObject | CanonicalView | None,
    backend: Features,
    top_k: int = 3,
    heatmap: bool = False,
) -> MatchResult:
    """One match without keeping anything; see :meth:`Matcher.match`."""
    return Matcher(backend).match(strategy, tools, target, top_k, heatmap)


__all__ = [
    "Further",
    "MatchResult",
    "Matcher",
    "Proposal",
    "Target",
    "Tool",
    "choose_target",
    "further_of",
    "match",
    "select",
    "target_contact",
    "target_view",
    "to_contact",
    "tool_of",
]
