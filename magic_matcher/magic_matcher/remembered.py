"""Matches of objects that have been matched before: the same objects come again and again, each time as another message."""

from __future__ import annotations

import threading
import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from magic_core.content import digest
from magic_core.recent import Recent
from magic_core.scene import SceneObject
from magic_core.strategy import Strategy
from magic_matcher.matching import Matcher, MatchResult

#: Bytes of pictures in the answers that are kept: some twenty.
MOST = 48 * 2**20


class Remembered:
    """Answers as :meth:`magic_matcher.matching.Matcher.match` does, at once where it was asked the same of the same objects a short while
    ago."""

    def __init__(self, matcher: Matcher) -> None:
        self._matcher = matcher
        self._answers: Recent[tuple[Any, ...], tuple[Strategy, MatchResult]] = Recent(MOST)
        self._lock = threading.Lock()

    def match(
        self, strategy: Strategy, tools: Sequence[SceneObject], target: SceneObject, top_k: int = 3, heatmap: bool = False
    ) -> MatchResult:
        """See :meth:`magic_matcher.matching.Matcher.match`; ``seconds`` are those of this answer.

        A strategy is the same where it is the same object: its files are read again where they have changed.
        """
        start = time.perf_counter()
        key = (id(strategy), top_k, heatmap, digest((*tools, target)))
        with self._lock:
            kept = self._answers.get(key)
        # The strategy is kept with the answer: while it lives no other one has its id.
        if kept is not None and kept[0] is strategy:
            return replace(kept[1], seconds=time.perf_counter() - start)
        result = self._matcher.match(strategy, tools, target, top_k, heatmap)
        with self._lock:
            if self._answers.get(key) is None:
                self._answers.put(key, (strategy, result), _bytes(result))
        return result


def _bytes(result: MatchResult) -> int:
    """What the pictures of an answer take."""
    pictures = [result.heatmap]
    for view in (*result.views.values(), result.target_view):
        if view is not None:
            pictures += [view.image, view.mask, view.depth]
    return sum(picture.nbytes for picture in pictures if picture is not None)
