"""Share of the levels of Eq. 9's integration that is done, and the deadline after which no level begins."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

from ..jit.batches import BATCH
from ..runtime.deadline import Deadline
from .work_log import WorkLog

TIMED_BATCHES = 16  # times as many batches with a deadline, which is exceeded by one of them at most


@dataclass(frozen=True)
class Progress:
    """Reports shares of a part of the work as shares of the whole: `start` … `stop` of it, in [0, 1].

    report : called with the share of the whole that is done; None: nothing is reported
    deadline : after which no further level or batch of lines of sight begins
    log : of the work, None: none is kept
    """

    report: Callable[[float], None] | None = None
    start: float = 0.0
    stop: float = 1.0
    deadline: Deadline = field(default_factory=Deadline)
    log: WorkLog | None = None

    def __call__(self, done: float) -> None:
        """Report that the share `done`, in [0, 1], of this part is done."""
        if self.report:
            self.report(self.start + done * (self.stop - self.start))

    def part(self, number: int, count: int) -> Progress:
        """The part of this `number`, from 0, of `count` equal parts."""
        width = (self.stop - self.start) / count
        ends = self.start + number * width, self.start + (number + 1) * width
        return Progress(self.report, *ends, self.deadline, self.log)

    @property
    def batch(self) -> int:
        """Most lines of sight of a batch."""
        return BATCH // TIMED_BATCHES if self.deadline.is_set else BATCH


SILENT = Progress()  # reports nothing
