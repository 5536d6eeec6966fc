"""The memory of the network: packets of templates, and places (section 4; "4. Place" of the semantics)."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from tests.oracle.cells import Pose
from tests.oracle.trace import Parameters

NONE, CREATE, EDGE, SET = 0, 1, 2, 3
RECENT = 10
UNSIGNED = 2**32


def short_way(a: float, b: float, n: float) -> float:
    """The distance between two coordinates around a ring."""
    return min(abs(a - b), n - abs(a - b))


@dataclass
class Memory:
    """The network's record of a template: its packet, its habituation and its experiences."""

    packet: Pose
    decay: float
    experiences: list[int] = field(default_factory=list)


@dataclass(frozen=True)
class Experience:
    """A pose of the network with the template seen there."""

    packet: Pose
    template: int


class StockPlaces:
    """Section 4 without the activity: template decays, experiences and the decision about actions."""

    def __init__(self, parameters: Parameters) -> None:
        self.parameters = parameters
        self.memories: list[Memory] = []
        self.experiences: list[Experience] = []
        self.template = self.previous_template = 0
        self.experience = 0
        # Written only together with an injection, so it is stale otherwise; the traces start it at 0 (Q14).
        self.turned = 0.0
        self.viewed = self.moved = False

    def see(self, template: int, relative: float, best: Pose) -> tuple[float, Pose] | None:
        """`on_view_template`; returns the injected energy and its pose, if any."""
        p, n = self.parameters, len(self.memories)
        recalled = None
        if template >= n:
            if template != n:
                raise ValueError(
                    f"template {template} skips ids: only {n} are known, the stock engine aborts"
                )
            self.memories.append(Memory(best, p.vt_active_decay))
        # Unsigned arithmetic: with fewer than ten templates the bound is huge and everything passes (Q1).
        elif template < (n - RECENT) % UNSIGNED:
            recalled = self.recall(template, relative)
        for memory in self.memories:
            memory.decay = max(memory.decay - p.pc_vt_restore, p.vt_active_decay)
        self.previous_template, self.template = self.template, template
        self.viewed = True
        return recalled

    def recall(self, template: int, relative: float) -> tuple[float, Pose] | None:
        """Step 2: habituates, and injects at the template's packet while its energy is positive."""
        p, memory = self.parameters, self.memories[template]
        if template == self.template:
            memory.decay += p.vt_active_decay
        # A long match habituates without limit (Q3), until exp overflows.
        energy = p.pc_vt_inject_energy / 30 * (30 - math.exp(min(1.2 * memory.decay, 700.0)))
        if energy <= 0:
            return None
        self.turned = relative * p.pc_dim_th / (2 * math.pi)
        x, y, th = memory.packet
        return energy, (x, y, self.wrapped_once(th + self.turned))

    def wrapped_once(self, th: float) -> float:
        """The heading in cells, brought back by at most one turn."""
        if th < 0:
            return th + self.parameters.pc_dim_th
        return th - self.parameters.pc_dim_th if th >= self.parameters.pc_dim_th else th

    def delta(self, experience: int, best: Pose) -> float:
        """Distance of an experience; cells of length and of heading count the same (Q23)."""
        n, headings = self.parameters.pc_dim_xy, self.parameters.pc_dim_th
        x, y, th = self.experiences[experience].packet
        return math.sqrt(
            short_way(best[0], x, n) ** 2
            + short_way(best[1], y, n) ** 2
            + short_way(self.wrapped_once(best[2] - self.turned), th, headings) ** 2
        )

    def act(self, best: Pose) -> int:
        """`get_action`: needs both a view and an odometry message since the last call."""
        ready = self.viewed and self.moved
        if not ready:
            # The other flag stays for the message that is still missing, which sets only its own.
            return NONE
        self.viewed = self.moved = False
        if not self.memories:
            return NONE
        listed = self.memories[self.template].experiences
        if not self.experiences or not listed:
            return self.create(best)
        threshold = self.parameters.exp_delta_pc_threshold
        far = self.delta(self.experience, best) > threshold
        if not far and self.template == self.previous_template:
            return NONE
        # Leaving out the current one makes setting it impossible (Q10).
        others = [(self.delta(e, best), e) for e in listed if e != self.experience]
        if others:
            nearest, experience = min(others, key=lambda other: other[0])
            if nearest < threshold:
                self.experience = experience
                return EDGE
        return self.create(best)

    def create(self, best: Pose) -> int:
        """A new experience at the decoded pose; it becomes the current one."""
        self.experience = len(self.experiences)
        self.experiences.append(Experience(best, self.template))
        self.memories[self.template].experiences.append(self.experience)
        return CREATE
