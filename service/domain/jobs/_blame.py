"""Attempts that count against their job.

A job that makes the engine fail must end; one whose workers are killed, for reasons of their own, must not. Both are
retried, by different counts.
"""

from __future__ import annotations

from dataclasses import dataclass

from service.settings import Settings

LESS_MEMORY = (
    "Ask for fewer keypoints (settings.max_keypoints) or smaller images (settings.max_side_px), split the drive, or "
    "give the worker more memory."
)
FULL_BLAME = 1.0
HALF_BLAME = 0.5
NO_BLAME = 0.0


@dataclass(frozen=True, kw_only=True)
class RetryLimits:
    """Limits on the attempts of a job.

    Attributes
    ----------
    max_attempts
        That count against the job: it ends with the one that reaches this.
    max_losses
        Attempts without blame that are lost one after the other while no stage is finished; the job ends with the last.
    """

    max_attempts: int
    max_losses: int = 20

    @classmethod
    def from_settings(cls, settings: Settings) -> RetryLimits:
        """Limits as the operator set them."""
        return cls(max_attempts=settings.max_attempts, max_losses=settings.max_losses)

    def allow(self, *, blame: float, losses: int) -> bool:
        """Return whether a job with these counts is tried once more."""
        return blame < self.max_attempts and losses < self.max_losses


def blame_of_loss(*, engine_ran: bool, memory_kills: int | None) -> float:
    """Count of an attempt whose process was killed.

    Parameters
    ----------
    engine_ran
        Whether the engine, which takes the memory, had begun.
    memory_kills
        How many processes the kernel killed there meanwhile for lack of memory; None where that is not known.
    """
    if memory_kills is None:
        return HALF_BLAME if engine_ran else NO_BLAME
    return FULL_BLAME if memory_kills else NO_BLAME
