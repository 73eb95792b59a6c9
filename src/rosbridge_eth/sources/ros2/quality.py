"""Which quality of service a subscription asks for, given what the publishers of its topic offer.

DDS 1.4, 2.2.3: a subscription gets nothing from a publisher that offers less than
it asks for (best effort < reliable, volatile < transient local). Asking for less
than is offered loses what could have been had: retransmission, the last latched
message. So it asks for the most that all publishers offer, and if what they
offer changes, the subscription changes too.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True, slots=True)
class Quality:
    """reliable: lost samples are sent again. latched: late subscribers get the last samples (transient local)."""

    reliable: bool
    latched: bool

    def __str__(self) -> str:
        return f"{'reliable' if self.reliable else 'best effort'}, {'transient local' if self.latched else 'volatile'}"


def quality_of(profile: Any) -> Quality:
    """What an endpoint's QoSProfile offers; a policy that is not known counts as the lesser."""
    return Quality(
        reliable=profile.reliability.name == "RELIABLE",
        latched=profile.durability.name in ("TRANSIENT_LOCAL", "PERSISTENT"),
    )


def most_that_all_offer(offered: Iterable[Quality]) -> Quality:
    """What a subscription can ask for and be matched by every one of them; of none: the most."""
    known = list(offered)
    return Quality(all(quality.reliable for quality in known), all(quality.latched for quality in known))
