"""Conformance checks of a SLAM method (backend): its entry, its kernel, its sessions and its map.

The sessions walk laps of a small circuit with repeated views. They must give the same bits live, replayed,
mixed, restored and repeated, finite results also after invalid input, and compile once per capacity.
"""

from __future__ import annotations

import inspect
import io
import tempfile
from collections.abc import Iterator, Sequence
from enum import IntEnum
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import Any

import jax
import networkx
import numpy as np

from ratslam.core.backend import Backend, Map
from ratslam.core.compilation import prepare_precision
from ratslam.core.estimates import Action, Estimate
from ratslam.core.session import CHUNK, Session, Step, capacity_at
from ratslam.methods.method_registry import BACKENDS, BackendEntry, Sensors
from ratslam.service.check_results import (
    Result,
    Trial,
    Violation,
    check,
    find_parts,
    leaves,
    require,
    require_equal,
)
from tactile.base.errors import InputError
from tactile.base.types import Observation, Odometry, observation
from tactile.whisker_geometry import PlanarWhiskers

VIEW = (3, 6, 1)
WHISKERS, REACH = 18, 0.2
"""Number and length (m) of the whiskers, which point in all directions from the robot's centre."""
STEPS, CAPACITY = 340, 256
"""Steps of the longest walk: a backend that stores every step grows once in it, from `CAPACITY`."""
CIRCUIT = 17
"""Places of the circuit."""
ENTRY, KERNEL, SESSION = range(3)
"""Groups of checks, in their order."""
LIVE, SHORT, BATCHED = 150, 3 * CHUNK, 20
"""Steps compared: live and mixed; of further sessions; of a batch."""
STOPS = (1, 176, 205, 256, 300)
"""Steps at which a session is stopped and restored, inside chunks and at their ends."""
RESERVED = 512
"""Rows reserved by a session that must not compile again in `STEPS` steps."""

_bearing = np.arange(WHISKERS) * 2 * np.pi / WHISKERS
_around = np.stack([np.cos(_bearing), np.sin(_bearing)], axis=1)
FEELERS = PlanarWhiskers(np.zeros((WHISKERS, 2)), _around, np.full(WHISKERS, REACH))
SENSORS = {"with whiskers": Sensors(VIEW, FEELERS), "without whiskers": Sensors(VIEW)}


class BackendTrial(Trial[BackendEntry]):
    """A method with settings: what its checks share, and the checks."""

    def build(self, dtype: Any = np.float64) -> Backend:
        """A new backend for the first sensors that suit it."""
        return self.entry.build(self.settings, self.sensors, np.dtype(dtype))

    @cached_property
    def _built(self) -> dict[str, Backend | str]:
        """For each kind of sensors: the backend, or the text of the `InputError` that refuses them."""
        found: dict[str, Backend | str] = {}
        for name, sensors in SENSORS.items():
            try:
                found[name] = self.entry.build(self.settings, sensors, np.dtype(np.float64))
            except InputError as error:
                found[name] = str(error)
        return found

    @cached_property
    def sensors(self) -> Sensors:
        """The sensors of the walks: with whiskers, unless the method refuses them."""
        return next(SENSORS[name] for name, made in self._built.items() if not isinstance(made, str))

    def walk(self, count: int, seed: int = 0) -> list[Observation]:
        """The first observations of laps of a small circuit with repeated views; some steps have no view, and
        in some the whiskers are in contact."""
        stream, touch = np.random.default_rng(seed), np.random.default_rng([seed, 1])
        whiskers = 0 if self.sensors.feelers is None else WHISKERS
        places, walked = stream.random((CIRCUIT, *VIEW)), []
        for k in range(count):
            turn = 2 * np.pi / CIRCUIT + stream.normal(0, 0.01)
            odometry = Odometry(0.05 + stream.normal(0, 0.002), stream.normal(0, 0.002), turn, 0.1)
            seen, place = stream.random() > 0.1, k % CIRCUIT
            view, label = (places[place], place) if seen else (None, -1)
            o = observation(odometry, view, view_shape=VIEW, label=label, whiskers=whiskers)
            contact = touch.random(WHISKERS)[:whiskers] < (0.2 if k % 5 == 0 else 0.0)
            point = np.where(contact[:, None], REACH * _around[:whiskers], 0.0)
            walked.append(o._replace(contact=contact, point=point))
        return walked

    @property
    def backend(self) -> Backend:
        """The backend for these sensors; all checks share it."""
        return next(made for made in self._built.values() if not isinstance(made, str))

    @cached_property
    def types(self) -> tuple[Any, Any, Any, Any]:
        """Shapes and dtypes: the initial state, and state, estimate and evidence after a step."""
        key = jax.random.key(0)
        state = jax.eval_shape(lambda key: self.backend.init(key, CAPACITY), key)
        return state, *jax.eval_shape(self.backend.kernel, state, self.walk(1)[0])

    @cached_property
    def session(self) -> Session:
        return Session(self.backend)

    def fresh(self) -> Session:
        """The session of `backend` at its start; all checks share its compiled function."""
        self.session.restart()
        return self.session

    @cached_property
    def _replayed(self) -> tuple[list[Step], dict[str, np.ndarray], Map]:
        session = self.fresh()
        return list(session.replay(self.walk(STEPS))), session.arrays(), session.map

    @property
    def steps(self) -> list[Step]:
        """The steps of a replay of `walk(STEPS)`."""
        return self._replayed[0]

    @property
    def arrays(self) -> dict[str, np.ndarray]:
        """The arrays of the session after this replay."""
        return self._replayed[1]

    @property
    def map(self) -> Map:
        """The map of this replay."""
        return self._replayed[2]

    def _maps(self) -> tuple[tuple[int, Map], ...]:
        """An empty map and that of the walk, each with its number of steps."""
        return (0, self.backend.new_map()), (STEPS, self.map)

    @cached_property
    def single(self) -> tuple[Session, list[Step]]:
        """A session in single precision, and its steps in `walk(200)`."""
        session = Session(self.build(np.float32), precision="float32")
        return session, list(session.replay(self.walk(200)))

    @check(ENTRY, "the entry is complete", "a run needs settings, columns and outcomes by name")
    def entry_is_complete(self) -> str:
        entry = self.entry
        super().entry_is_complete.run(self)
        fields = getattr(entry.evidence, "_fields", ())
        require("outcome" in fields, f"evidence {entry.evidence!r}", "a NamedTuple with a field `outcome`")
        kind = entry.outcomes
        sound = isinstance(kind, type) and issubclass(kind, IntEnum) and len(kind) > 0
        require(sound, f"outcomes {kind!r}", "an IntEnum with members")
        columns = ", ".join(entry.columns())
        return f"columns {columns}" if columns else ""

    @check(ENTRY, "it builds", "a run builds it from its settings and the sensors of the source")
    def builds(self) -> str:
        refused = {name: made for name, made in self._built.items() if isinstance(made, str)}
        if len(refused) == 2:
            found = "; ".join(f"{name}: {text}" for name, text in refused.items())
            raise Violation(found, "a backend for views of (3, 6, 1) with or without whiskers")
        return f"refused {next(iter(refused.items()))[0]}" if refused else "with and without whiskers"

    @check(ENTRY, "backend and map have all methods", "the session calls each of them")
    def has_all_methods(self) -> None:
        for part, protocol in ((self.backend, Backend), (self.backend.new_map(), Map)):
            needed = [name for name, _ in inspect.getmembers(protocol, inspect.isfunction) if name[0] != "_"]
            missing = [name for name in needed if not callable(getattr(part, name, None))]
            found, name = f"{type(part).__name__} without {', '.join(missing)}", protocol.__name__
            require(not missing, found, f"the methods of ratslam.core.backend.{name}; inherit it")

    @check(KERNEL, "the kernel keeps the state's types", "a chunk scans the kernel, and would not compile")
    def keeps_types_of_state(self) -> None:
        before, after, *_ = self.types
        structures = [str(jax.tree.structure(state)) for state in (before, after)]
        if structures[0] != structures[1]:
            raise Violation(" becomes ".join(structures), "the state's structure unchanged")
        changes = [
            f"{path} is {_kind(old)} before a step and {_kind(new)} after it"
            for (path, old), new in zip(_state_leaves(before), jax.tree.leaves(after), strict=True)
            if _kind(old) != _kind(new)
        ]
        require(not changes, "; ".join(changes), "the same shape, dtype and weak type")
        weak = ", ".join(path for path, leaf in _state_leaves(before) if leaf.weak_type)
        require(not weak, f"weakly typed {weak}", "arrays with a dtype, as jnp.zeros(n, dtype) makes")

    @check(
        KERNEL,
        "the state has the session's precision",
        "a float32 session would compute in float64, or not at all",
    )
    def state_has_precision(self) -> None:
        key = jax.random.key(0)
        for name in ("float64", "float32"):
            backend = self.backend if name == "float64" else self.build(name)
            state = jax.eval_shape(lambda key, backend=backend: backend.init(key, CAPACITY), key)
            wrong = ", ".join(
                f"state{jax.tree_util.keystr(path)} {leaf.dtype}"
                for path, leaf in jax.tree.leaves_with_path(state)
                if jax.dtypes.issubdtype(leaf.dtype, np.floating)
                and leaf.dtype != name
                and getattr(path[0], "name", "") not in backend.SINGLE
            )
            require(not wrong, f"{wrong} in a {name} session", f"{name}, the dtype given to `build`")

    @check(KERNEL, "the estimate has its types", "run directories and maps are written from it")
    def estimate_has_types(self) -> None:
        estimate = self.types[2]
        found = f"an estimate of type {type(estimate).__name__}"
        require(isinstance(estimate, Estimate), found, "ratslam.core.estimates.Estimate")
        kinds: dict[str, tuple[tuple[int, ...], Any]] = {
            **dict.fromkeys(("pose", "spread"), ((3,), np.floating)),
            **dict.fromkeys(("place", "previous", "action"), ((), np.int32)),
            "lost": ((), np.bool_),
        }
        for name, (shape, kind) in kinds.items():
            leaf = getattr(estimate, name)
            fits = leaf.shape == shape and jax.dtypes.issubdtype(leaf.dtype, kind)
            require(fits, f"{name} is {leaf.dtype} {leaf.shape}", f"{kind.__name__} {shape}")

    @check(KERNEL, "the evidence has its types", "steps.csv is written from it")
    def evidence_has_types(self) -> None:
        evidence, kind = self.types[3], self.entry.evidence
        found = f"evidence of type {type(evidence).__name__}"
        require(isinstance(evidence, kind), found, f"{kind.__name__}, as registered")
        outcome = evidence.outcome
        fits = (outcome.shape, outcome.dtype) == ((), np.int32)
        require(fits, f"outcome is {outcome.dtype} {outcome.shape}", "int32 ()")
        for name in self.entry.columns():
            shape = getattr(evidence, name).shape
            require(shape == (), f"{name}, annotated Scalar, has shape {shape}", "()")

    @check(SESSION, "every outcome is declared", "the outcome of a step is written by its name")
    def declares_outcomes(self) -> str:
        declared = {int(outcome) for outcome in self.entry.outcomes}
        found = [int(step.evidence.outcome) for step in self.steps]
        wrong = [k for k, outcome in enumerate(found) if outcome not in declared]
        if wrong:
            names = ", ".join(f"{outcome.value} {outcome.name}" for outcome in self.entry.outcomes)
            raise Violation(f"outcome {found[wrong[0]]} at step {wrong[0]}", f"one of {names}")
        return ", ".join(self.entry.outcomes(outcome).name for outcome in sorted(set(found)))

    @check(SESSION, "results are finite", "one NaN spoils all later poses")
    def is_finite(self) -> None:
        _require_finite(self.steps, "an ordinary walk")

    @check(SESSION, "invalid input gives finite results", "sensors fail; the session must go on")
    def is_finite_after_invalid_input(self) -> None:
        first = self.walk(1)[0]
        still = first._replace(view=np.full(VIEW, 0.5), view_seen=np.bool_(True), label=np.int32(3))
        odd, endless = (
            still._replace(odometry=Odometry(*map(np.float64, (*motion, 0.1))))
            for motion in ((np.nan, np.inf, 0.0), (0.0, 0.0, -np.inf))
        )
        inputs = {
            "odometry of NaN": odd,
            "odometry of infinity": endless,
            "a view of NaN": still._replace(view=np.full(VIEW, np.nan)),
            "no view": still._replace(view=np.zeros(VIEW), view_seen=np.bool_(False), label=np.int32(-1)),
            "an ordinary step after these": still,
        }
        session = self.fresh()
        _require_finite([session.step(still)], "an ordinary walk")
        for name, one in inputs.items():
            _require_finite([session.step(one)], f"a walk with {name}")

    @check(SESSION, "it is deterministic", "a result could not be reproduced")
    def is_deterministic(self) -> None:
        found = list(Session(self.build()).replay(self.walk(SHORT)))
        require_equal(self.steps[:SHORT], found, "two sessions of equal settings, seed and input")

    @check(SESSION, "it keeps no state of its own", "sessions of one backend would disturb each other")
    def separates_sessions(self) -> None:
        first, second = self.fresh(), Session(self.backend)
        ours, others = self.walk(SHORT), self.walk(SHORT, seed=1)
        found: list[Step] = []
        beside: list[Step] = []
        for k in range(0, SHORT, CHUNK):
            found += first.replay(ours[k : k + CHUNK])
            beside += second.replay(others[k : k + CHUNK])
        require_equal(self.steps[:SHORT], found, "a session alone and beside another one")
        second.restart()
        require_equal(list(second.replay(others)), beside, "a session alone and beside another one")

    @check(SESSION, "live and replay give the same bits", "a recording would not show what the robot did")
    def replays_as_live(self) -> None:
        expected, live = self.steps[:LIVE], self.fresh()
        require_equal(expected, [live.step(o) for o in self.walk(LIVE)], "replay and live")

    @check(SESSION, "any mixture of live and replay gives the same bits", "a session may change between them")
    def mixes_live_and_replay(self) -> None:
        observations, mixed = self.walk(LIVE), self.fresh()
        found = [mixed.step(o) for o in observations[:30]]
        found += mixed.replay(observations[30:101])
        found += [mixed.step(o) for o in observations[101:110]]
        found += mixed.replay(observations[110:])
        require_equal(self.steps[:LIVE], found, "replay and a mixture of live and replay")

    @check(SESSION, "a checkpoint continues with the same bits", "`run --continue` would change the map")
    def continues_checkpoints(self) -> None:
        expected, observations = self.steps, self.walk(STEPS)
        first, saved = self.fresh(), list[dict[str, Any]]()
        for begin, stop in pairwise((0, *STOPS)):
            list(first.replay(observations[begin:stop]))
            file = io.BytesIO()  # as a checkpoint file gives the arrays back
            given: dict[str, Any] = first.arrays()
            np.savez(file, **given)
            file.seek(0)
            with np.load(file, allow_pickle=False) as found:
                saved.append({name: found[name] for name in found.files})
        for stop, arrays in zip(STOPS, saved, strict=True):
            second = self.fresh()
            second.restore(arrays)
            what = f"a session and one restored after step {stop}"
            require_equal(expected[stop:], list(second.replay(observations[stop:])), what)
            require_equal(self.arrays, second.arrays(), f"the arrays of {what}")

    @check(SESSION, "it compiles once per capacity", "a live robot would wait for the compiler")
    def compiles_once(self) -> str:
        observations = self.walk(STEPS)
        reserved = Session(self.backend, reserve=RESERVED)
        for o in observations[:5]:
            reserved.step(o)
        list(reserved.replay(observations[5:]))
        count = reserved.compilations()
        require(count == 1, f"{count} compilations in {STEPS} steps with {RESERVED} rows reserved", "1")
        replayed = len(self.steps)  # by the same compiled functions
        session = self.fresh()
        for o in observations[:5]:
            session.step(o)
        capacities = len({capacity_at(step) for step in range(replayed)})
        count = session.compilations()
        found = f"{count} compilations of sessions with {capacities} capacities"
        require(count <= capacities, found, "one per capacity")
        return f"{count} in {STEPS} steps from {CAPACITY} rows"

    @check(SESSION, "warming up changes no result", "a live session compiles before it starts")
    def warms_up(self) -> None:
        session = Session(self.backend)
        first, *_ = self.walk(1)
        session.rehearse(first, 0.05)
        session.warm(first)
        require(session.steps == 0, f"{session.steps} steps after warming up", "none")
        found = [session.step(o) for o in self.walk(SHORT)]
        require_equal(self.steps[:SHORT], found, "a session and one warmed up before it")
        count = session.compilations()
        require(count == 1, f"{count} compilations in a session warmed up before its first step", "1")

    @check(SESSION, "a batch equals its members", "studies and batches vmap the kernel")
    def computes_batches(self) -> None:
        backend = self.backend
        runs = [self.walk(BATCHED, seed) for seed in range(3)]
        batch = [jax.tree.map(lambda *rows: np.stack(rows), *step) for step in zip(*runs, strict=True)]
        options = {"xla_backend_optimization_level": 0}  # few steps: compiling takes most of the time
        one = jax.jit(backend.kernel, compiler_options=options)
        many = jax.jit(jax.vmap(backend.kernel), compiler_options=options)
        alone = [backend.init(jax.random.key(0), CAPACITY) for _ in runs]
        together = jax.tree.map(lambda *rows: np.stack(rows), *alone)
        for k, step in enumerate(batch):
            together, estimate, _ = many(together, step)
            for r, run in enumerate(runs):
                alone[r], expected, _ = one(alone[r], run[k])
                same = np.allclose(estimate.pose[r], expected.pose, atol=1e-9)
                same &= bool(estimate.place[r] == expected.place)
                same &= bool(estimate.action[r] == expected.action)
                found = f"pose {estimate.pose[r]} in a batch and {expected.pose} alone at step {k}"
                require(same, found, "the same estimate within 1e-9")

    @check(SESSION, "places are consistent", "places and links of the map are read from them")
    def numbers_places(self) -> str:
        previous, known = -1, set[int]()
        for k, step in enumerate(self.steps):
            place, action = int(step.estimate.place), Action(int(step.estimate.action))
            what = f"action {action.name} from place {previous} to {place} at step {k}"
            before, expected = int(step.estimate.previous), f"{previous}, the place of the step before"
            require(before == previous, f"previous {before} at step {k}", expected)
            if action == Action.CREATE:
                require(place not in known, what, "a place that is new")
            elif action in (Action.LINK, Action.SET):
                require(place in known and place != previous, what, "another place that is known")
            else:
                require(place == previous, what, "the same place")
            known.add(place)
            previous = place
        return f"{len(known - {-1})} places"

    @check(SESSION, "single precision stays single", "float32 sessions would be slow, or not run")
    def stays_single(self) -> None:
        session, steps = self.single
        _require_finite(steps, "a walk in float32")
        grown = session.backend.grow(session.state, 2 * CAPACITY)
        kinds = {"state": session.state, "state after `grow`": grown}
        found = [leaf for name, state in kinds.items() for leaf in _state_leaves(state, name)]
        found += [*leaves(steps[-1].estimate, "estimate"), *leaves(steps[-1].evidence, "evidence")]
        # The map may complete the estimate with Python numbers.
        wrong = [path for path, leaf in found if getattr(leaf, "dtype", None) == np.float64]
        require(not wrong, f"float64 in {', '.join(wrong)} of a float32 session", "float32")

    @check(SESSION, "trajectories are [T, 3] and finite", "trajectory.tum is written from them")
    def gives_trajectories(self) -> None:
        for count, made in self._maps():
            for name in ("trajectory", "map_trajectory", "online_trajectory"):
                poses = np.asarray(getattr(made, name)())
                found = f"{name} {poses.shape} after {count} steps"
                require(poses.shape == (count, 3), found, f"({count}, 3)")
                require(bool(np.isfinite(poses).all()), f"{name} with NaN or infinity", "finite poses")

    @check(SESSION, "closures are pairs of steps", "they are counted, drawn and scored")
    def gives_closures(self) -> str:
        for count, made in self._maps():
            pairs = np.asarray(made.closures())
            sound = pairs.ndim == 2 and pairs.shape[1] == 2 and pairs.dtype.kind in "iu"
            require(sound, f"closures {pairs.dtype} {pairs.shape} after {count} steps", "integers (M, 2)")
            later, earlier = pairs.T
            ordered = bool(((earlier >= 0) & (earlier < later) & (later < count)).all())
            found = f"closures {pairs[:3].tolist()} of {count} steps"
            require(ordered, found, "later and earlier step of each")
        return f"{len(pairs)} closures"

    @check(SESSION, "every step is in a piece", "plots and scores treat pieces separately")
    def gives_pieces(self) -> None:
        for count, made in self._maps():
            pieces = np.asarray(made.pieces())
            sound = pieces.shape == (count,) and pieces.dtype.kind in "iu"
            found = f"pieces {pieces.dtype} {pieces.shape} after {count} steps"
            require(sound, found, f"integers ({count},)")
        numbers = sorted(set(pieces.tolist()))
        sound = pieces[0] == 0 and numbers == list(range(len(numbers)))
        require(sound, f"pieces {numbers}", "numbers from 0")

    @check(SESSION, "doubt is a probability", "a doubted map is replaced by odometry")
    def gives_doubt(self) -> None:
        for name in ("doubt", "final_doubt"):
            value = float(getattr(self.map, name)())
            require(np.isnan(value) or 0 <= value <= 1, f"{name} {value}", "a probability, or NaN")

    @check(SESSION, "the map's files and graph can be written", "a run ends with writing them")
    def writes_files(self) -> str:
        made = self.map
        graph = made.graph()
        found = f"graph of type {type(graph).__name__}"
        require(isinstance(graph, networkx.DiGraph), found, "networkx.DiGraph")
        with tempfile.TemporaryDirectory() as folder:
            for name, write in made.files().items():
                require(Path(name).name == name, f"file {name!r}", "a name without a folder")
                write(Path(folder) / name)
                there = [path.name for path in Path(folder).iterdir()]
                require(name in there, f"{name!r} not written", "the file at the path given")
        return ", ".join(made.files())

    @check(SESSION, "the map's arrays are named NumPy arrays", "checkpoints are npz files without pickles")
    def gives_arrays(self) -> None:
        arrays = self.map.arrays()
        require(isinstance(arrays, dict), f"arrays of type {type(arrays).__name__}", "a dict by name")
        for name, array in arrays.items():
            sound = isinstance(name, str) and isinstance(array, np.ndarray) and array.dtype != object
            found = f"{name!r}: {getattr(array, 'dtype', type(array).__name__)}"
            require(sound, found, "NumPy arrays of numbers by name")


def _require_finite(steps: list[Step], what: str) -> None:
    for k, step in enumerate(steps):
        record = {"pose of the map": step.pose, "pose": step.estimate.pose, "spread": step.estimate.spread}
        for name, value in record.items():
            require(bool(np.isfinite(value).all()), f"{name} {value} at step {k} of {what}", "finite numbers")


def check_backend(name: str, assignments: Sequence[str] = ()) -> Iterator[Result]:
    """Checks the method of a name, with its settings as assignments `settings.key=value`; raises as
    `find_parts`."""
    entry, settings = find_parts({"settings": (BACKENDS, name, "check backend")}, assignments)["settings"]
    prepare_precision("float64")
    return BackendTrial(entry, settings).run_checks()


def _state_leaves(state: Any, name: str = "state") -> list[tuple[str, Any]]:
    """The arrays of a state, each with its path."""
    return [(name + jax.tree_util.keystr(path), leaf) for path, leaf in jax.tree.leaves_with_path(state)]


def _kind(leaf: Any) -> str:
    return f"{'weak ' if leaf.weak_type else ''}{leaf.dtype} {leaf.shape}"
