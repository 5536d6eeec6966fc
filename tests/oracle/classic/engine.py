"""The three processes wired together (section 2)."""

from __future__ import annotations

from collections.abc import Callable
from math import nan
from typing import NamedTuple

import numpy as np

from tests.oracle.cells import Array
from tests.oracle.classic.map import ExperienceMap
from tests.oracle.classic.places import Action, Injection, Places, truncated
from tests.oracle.classic.views import Views
from tests.oracle.params import Params
from tests.oracle.trace import Row
from tests.oracle.views import GivenViews, Match


class Outcome(NamedTuple):
    """What one row of a stream leads to; the names are those of the recorded columns."""

    vt: int
    vt_err: float
    rel_rad: float
    inj_energy: float
    inj_x: int
    inj_y: int
    inj_th: int
    best_x: float
    best_y: float
    best_th: float
    max_act: float
    total: float
    min_act: float
    nnz: int
    vt_delta_pc_th: float
    delta_pc: float
    action: int
    src: int
    dest: int
    pc_exp: int
    em_exp: int
    em_x: float
    em_y: float
    em_th: float
    acc_dx: float
    acc_dy: float
    acc_facing: float
    n_vt: int
    n_exp: int
    n_links: int


class Clock:
    """Time between odometry messages; a stamp of exactly 0 counts as none (Q22)."""

    def __init__(self) -> None:
        self.stamp = 0.0

    def tick(self, stamp: float) -> float | None:
        """Seconds since the last message, if there was one."""
        before, self.stamp = self.stamp, stamp
        return stamp - before if before else None


class Engine:
    """OpenRatSLAM: views first, then odometry to the map and to the network, then what follows from both."""

    def __init__(
        self, params: Params, given: bool = False, cell_of: Callable[..., tuple[int, int, int]] = truncated
    ) -> None:
        self.views = GivenViews() if given else Views(params)
        self.places = Places(params, cell_of)
        self.map = ExperienceMap(params)
        self.clock = Clock()
        self.match = Match(-1, 0.0, 0.0)

    def step(self, row: Row) -> Outcome:
        """One row of a stream: a view, an odometry message, or both."""
        injection = None
        if row.view is not None:
            self.match = self.views.match(row.view)
            injection = self.places.on_view(self.match.template, self.match.relative)
        action, source, delta = Action.NONE, self.places.current, nan
        dt = self.clock.tick(row.time) if row.moves else None
        if dt is not None:
            self.map.on_odometry(row.v, row.w, dt)
            self.places.on_odometry(row.v, row.w, dt)
            if self.places.experiences:
                delta = self.places.delta(self.places.experiences[source])
            action = self.places.action()
            self._tell_map(action, source, self.places.current)
        return self._outcome(injection, action, source, delta)

    def _tell_map(self, action: Action, source: int, target: int) -> None:
        """The map relaxes when it is told of an action, and only then."""
        if action == Action.NONE:
            return
        relative = self.places.delta_heading * 2 * np.pi / self.places.params.pc_dim_th
        if action == Action.CREATE_NODE:
            self.map.create()
            self.map.set(target, 0.0)
        else:
            self.map.link(source, target, relative)
            self.map.set(target, relative)
        self.map.iterate()

    def _outcome(self, injection: Injection | None, action: Action, source: int, delta: float) -> Outcome:
        places, map_ = self.places, self.map
        P, best = places.network.P, places.network.best
        energy, (th, y, x) = injection or Injection(0.0, (-1, -1, -1))
        here = map_.current
        node = (map_.x[here], map_.y[here], map_.th[here]) if map_.x else (nan, nan, nan)
        return Outcome(
            vt=self.match.template,
            vt_err=self.match.error,
            rel_rad=self.match.relative,
            inj_energy=energy,
            inj_x=x,
            inj_y=y,
            inj_th=th,
            best_x=best.x,
            best_y=best.y,
            best_th=best.th,
            max_act=float(P.max()),
            total=float(P.sum()),
            min_act=float(P.min()),
            nnz=int(np.count_nonzero(P)),
            vt_delta_pc_th=places.delta_heading,
            delta_pc=delta,
            action=action,
            src=source,
            dest=places.current,
            pc_exp=places.current,
            em_exp=here,
            em_x=node[0],
            em_y=node[1],
            em_th=node[2],
            acc_dx=map_.dx,
            acc_dy=map_.dy,
            acc_facing=map_.facing,
            n_vt=len(places.templates),
            n_exp=len(places.experiences),
            n_links=len(map_.joined),
        )

    def map_table(self) -> Array:
        """Nodes as recorded: id, x, y, heading, and the experience's cells and template."""
        rows = zip(self.map.x, self.map.y, self.map.th, self.places.experiences, strict=True)
        table = [(k, x, y, th, *e.pose, e.template) for k, (x, y, th, e) in enumerate(rows)]
        return np.array(table, dtype=float).reshape(-1, 8)

    def link_table(self) -> Array:
        """Links as recorded."""
        return np.array(self.map.links, dtype=float).reshape(-1, 6)

    def template_table(self) -> Array:
        """Templates as recorded: id, cells, decay, number of experiences."""
        known = enumerate(self.places.templates)
        table = [(k, *t.pose, t.decay, len(t.experiences)) for k, t in known]
        return np.array(table, dtype=float).reshape(-1, 6)
