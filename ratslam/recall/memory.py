"""The memory of recall: a view cell for every keyframe, and what it takes over from the map.

Each keyframe keeps the view and the pose in the map at which it was stored, as the view templates of RatSLAM
keep a view and the packet's pose (Milford & Wyeth 2004; Ball et al. 2013, section 3). Between keyframes the
odometry adds up; when it is long enough, the next view becomes a keyframe (`Memory.is_keyframe_due`). Where
keyframes are is decided by the map: its poses and what it has learned of the sensors come back as
`MapFeedback`.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from ratslam.recall.config import RecallConfig, sector_shifts
from ratslam.recall.signed_likelihood import packed_shape
from ratslam.recall.whisker_likelihood import LEVELS
from tactile.base.se2 import compose, correct_heading
from tactile.base.types import Array

NO_LIKENESS = np.zeros((0, 0, 0))


class MapFeedback(NamedTuple):
    """Values of the map that the view cells take over.

    Attributes:
        poses: [N, 3] of all keyframes, m, m, rad. bias: heading bias, rad/m. turn_error: correction of turns,
            rad/rad. since: distance travelled since
            the last closure, m. angle: turn per sector shift, rad, 0 while unknown; whiskers: half a turn.
            scale: view error below which different places seldom come; whiskers: log-odds that stand for an
            image never seen before; 0 while unknown. likeness: [G, L, L] see `log_odds_table`, or of signed
            images, see `signed_likelihood.pack`; empty except for whiskers. start: [3] pose of the
            next keyframe if a piece of the map begins with it; None: it follows the newest one.
    """

    poses: np.ndarray
    bias: float
    turn_error: float
    since: float
    angle: float
    scale: float
    likeness: np.ndarray = NO_LIKENESS
    start: np.ndarray | None = None


class MergedRows(NamedTuple):
    """Rows, of a map or of the memory, after keyframes were merged or restored: old row to new row.

    Attributes:
        source: [n] the former row of each row, or the one that its keyframe was merged with. onto: [N] the
            row that each former row now is or is merged with. offset: [N, 3] its pose in the frame of that
            one, m, m, rad; zero for `source`. view: [n, D] and label: [n] of the keyframes, for the memory.
    """

    source: np.ndarray
    onto: np.ndarray
    offset: np.ndarray
    view: np.ndarray = np.zeros((0, 0))
    label: np.ndarray = np.zeros(0, np.int32)

    @classmethod
    def of_none(cls, count: int) -> MergedRows:
        """All of `count` rows remain."""
        return cls(np.arange(count), np.arange(count), np.zeros((count, 3)))

    @property
    def rows(self) -> int:
        """Number of rows thereafter."""
        return len(self.source)

    def is_kept(self) -> np.ndarray:
        """[N] bool, former rows that are merged with no other."""
        kept = np.zeros(len(self.onto), bool)
        kept[self.source] = True
        return kept

    def turned(self) -> np.ndarray:
        """[N] bool: former rows whose keyframes face opposite to those that they are merged with."""
        return np.cos(self.offset[:, 2]) < 0


class CroppedRows(NamedTuple):
    """Rows of the memory after a map was cropped.

    Attributes:
        rows: the rows that remain; those that do not are taken to be merged with any other. left: [N] bool,
            former rows that remain. motion, length, turn: [3], m, rad: odometry from the newest row that
            remains to the newest former one. elsewhere: the robot is in a piece of the map that is gone, so
            that there is no such odometry.
    """

    rows: MergedRows
    left: np.ndarray
    motion: np.ndarray
    length: float
    turn: float
    elsewhere: bool


class Memory(NamedTuple):
    """All keyframes, rows in order of time.

    Attributes:
        view: [D, C]; whiskers: levels, int32, or signed images as stored. label: [C] int32.
        x, y, heading: [C] poses in the map, m, m, rad; cosine, sine: [C] of the heading, because computing
            them at every step takes longer than what they are for. count, distinct: number of keyframes and
            of known labels, int32.
        pose: [3] of the newest keyframe. motion, length, turn: odometry since then: [3], m, rad.
        bias, turn_error, since, angle, scale, likeness: see `MapFeedback`.
        before: [S, C] likelihoods of the previous image, for whiskers only, else of size 0.
    """

    view: Array
    label: Array
    x: Array
    y: Array
    heading: Array
    cosine: Array
    sine: Array
    count: Array
    distinct: Array
    pose: Array
    motion: Array
    length: Array
    turn: Array
    bias: Array
    turn_error: Array
    since: Array
    angle: Array
    scale: Array
    likeness: Array
    before: Array

    def recallable(self, config: RecallConfig) -> Array:
        """[C] bool, the keyframes that may be recalled."""
        return jnp.arange(self.label.shape[0], dtype=jnp.int32) < self.count - config.guard

    def allowed_shifts(self, shifts: np.ndarray) -> Array:
        """[S] bool, the shifts to compare: all once the sectors are known to be ordered, else 0 alone."""
        return (shifts == 0) | (self.angle != 0)

    def corrected_motion(self) -> Array:
        """[3] motion since the newest keyframe without the systematic errors of the odometry."""
        return correct_heading(self.motion, self.length, self.bias, self.turn_error)

    def current_pose(self) -> Array:
        """[3] the robot's pose in the map at the last feedback, moved on by odometry."""
        return compose(self.pose, self.corrected_motion())

    def pose_spread(self, config: RecallConfig, cell: float) -> tuple[Array, Array]:
        """Standard deviation of the current pose: position, m, and heading, rad."""
        since = self.since + self.length
        position = config.local_sd * cell + config.local_rate * since
        return position, config.local_heading + config.local_heading_rate / cell * since

    def store_keyframe(self, view: Array, label: Array) -> Memory:
        """Stores the newest view as a keyframe at the robot's current pose.

        Args:
            view: [D] or more values as they are compared, those beyond D are not stored. label: int32 place
                id, -1 for none.
        """
        row, pose = self.count, self.current_pose()
        zero = jnp.zeros_like(self.length)
        known = jnp.any(self.label == label) | (label < 0)
        return self._replace(
            view=self.view.at[:, row].set(view[: self.view.shape[0]]),
            label=self.label.at[row].set(label),
            x=self.x.at[row].set(pose[0]),
            y=self.y.at[row].set(pose[1]),
            heading=self.heading.at[row].set(pose[2]),
            cosine=self.cosine.at[row].set(jnp.cos(pose[2])),
            sine=self.sine.at[row].set(jnp.sin(pose[2])),
            count=self.count + 1,
            distinct=self.distinct + (~known).astype(jnp.int32),
            pose=pose,
            motion=jnp.zeros_like(self.motion),
            since=self.since + self.length,
            length=zero,
            turn=zero,
        )

    def pack_feedback(self, feedback: MapFeedback) -> tuple[np.ndarray, np.ndarray, Array]:
        """The feedback of a map of a keyframe or more, in arrays of fixed shapes; copied, because the map
        changes its arrays in place.

        Returns:
            rows [5, C]: x, y, heading, its cosine and sine of all keyframes, 0 after the last; values [8]:
            pose of the newest keyframe, bias, turn error, distance, angle, scale; likeness: see
            `MapFeedback`.
        """
        dtype, count = self.x.dtype, len(feedback.poses)
        newest = feedback.poses[-1] if feedback.start is None else feedback.start
        rows = np.zeros((5, self.x.shape[0]), dtype)
        x, y, heading = feedback.poses.T
        rows[:, :count] = x, y, heading, np.cos(heading), np.sin(heading)
        rest = feedback.bias, feedback.turn_error, feedback.since, feedback.angle, feedback.scale
        likeness = np.array(feedback.likeness, dtype) if feedback.likeness.size else self.likeness
        return rows, np.array([*newest, *rest], dtype), likeness

    def take_feedback(self, feedback: tuple[Array, Array, Array]) -> Memory:
        """The memory with the map's current poses and view metric, packed by `pack_feedback`."""
        (x, y, heading, cosine, sine), values, likeness = feedback
        bias, turn_error, since, angle, scale = values[3:]
        return self._replace(
            x=x, y=y, heading=heading, cosine=cosine, sine=sine, pose=values[:3],
            bias=bias, turn_error=turn_error, since=since, angle=angle, scale=scale, likeness=likeness,
        )  # fmt: skip

    def apply_map_feedback(self, feedback: MapFeedback) -> Memory:
        """The memory with the feedback of a map, of an empty one as it is."""
        if not len(feedback.poses):
            return self
        rows, values, likeness = self.pack_feedback(feedback)
        return self.take_feedback((jnp.asarray(rows), jnp.asarray(values), jnp.asarray(likeness)))

    def filled(self, feedback: MapFeedback, views: np.ndarray, labels: np.ndarray) -> Memory:
        """The memory with N keyframes in the place of none.

        Args:
            feedback: poses [N, 3] and view metric of the map. views: [N, D], labels: [N] as recall stores
                them.
        """
        filled = self._replace(
            view=_put(views.T, self.view),
            label=_put(labels, self.label, -1),
            count=jnp.int32(len(labels)),
            distinct=_distinct(labels),
        )
        return filled.apply_map_feedback(feedback)

    def first_keyframes(self, count: int) -> Memory:
        """The memory as if it held only its first `count` keyframes, and had seen no view before."""
        label = np.array(self.label)
        label[count:] = -1
        return self._replace(
            count=jnp.int32(count),
            label=jnp.asarray(label),
            distinct=_distinct(label),
            before=jnp.zeros_like(self.before),
        )

    def begin_piece(self) -> Memory:
        """The memory of a robot that may be anywhere: no odometry leads to the next keyframe, and the next
        view seen becomes one."""
        return self._replace(
            motion=jnp.zeros_like(self.motion),
            length=jnp.zeros((), self.x.dtype),
            turn=jnp.asarray(np.inf, self.x.dtype),
            before=jnp.zeros_like(self.before),
        )

    def merge_rows(self, merged: MergedRows) -> Memory:
        """The memory with these rows.

        Raises:
            ValueError: there are more rows than the memory holds.
        """
        count = merged.rows
        if count > self.label.shape[0]:
            raise ValueError(f"{count} keyframes do not fit into a memory of {self.label.shape[0]}")

        def take(rows: Array) -> Array:
            former = np.asarray(rows)
            return _put(former[..., merged.source], rows) if former.size else jnp.array(former)

        taken = ("x", "y", "heading", "cosine", "sine", "before")
        return self._replace(
            view=_put(merged.view.T, self.view),
            label=_put(merged.label, self.label, -1),
            count=jnp.array(count, jnp.int32),
            **{name: take(getattr(self, name)) for name in taken},
        )

    def crop_rows(self, cropped: CroppedRows) -> Memory:
        """The memory reduced to rows."""
        dtype, merged = self.x.dtype, self.merge_rows(cropped.rows)
        return merged._replace(
            distinct=_distinct(np.asarray(merged.label)[: cropped.rows.rows]),
            motion=jnp.asarray(compose(cropped.motion, np.asarray(self.motion)), dtype),
            length=self.length + jnp.asarray(cropped.length, dtype),
            turn=self.turn + jnp.asarray(cropped.turn, dtype),
        )

    def accumulate_motion(self, odometry: Array) -> Memory:
        """Adds body-frame motion to the odometry since the newest keyframe (path integration between views).

        Args:
            odometry: [3] of one step, m, m, rad.
        """
        length = self.length + jnp.hypot(odometry[0], odometry[1])
        turn = self.turn + jnp.abs(odometry[2])
        return self._replace(motion=compose(self.motion, odometry), length=length, turn=turn)

    def is_motion_due(self, config: RecallConfig, cell: float) -> Array:
        """bool: the robot has moved so far since the newest keyframe that a view is compared again.

        Args:
            cell: side of a pose cell, m: the unit of the lengths in `config`.
        """
        return (self.length >= config.frame_distance * cell) | (self.turn > config.frame_turn)

    def is_keyframe_due(self, config: RecallConfig, cell: float) -> Array:
        """bool: the present view becomes a keyframe, because the robot has moved far enough."""
        moved = self.is_motion_due(config, cell)
        return (self.count < self.label.shape[0]) & (moved | (self.count == 0))


def _put(rows: np.ndarray, like: Array, fill: float = 0) -> Array:
    """Rows [..., n] at the beginning of an array like another."""
    full = np.full(like.shape, fill, like.dtype)
    full[..., : rows.shape[-1]] = rows
    return jnp.array(full)


def _distinct(label: np.ndarray) -> Array:
    """int32 number of known labels."""
    return jnp.int32(len(np.unique(label[label >= 0])))


def init_memory(config: RecallConfig, size: int, capacity: int, dtype: np.dtype, groups: int = 0) -> Memory:
    """A memory without keyframes.

    Args:
        size: number of values of a view, D; 0 for recordings with given place ids. groups: number of whisker
            groups, G, see `log_odds_table`.
    """

    def zeros(*shape: int) -> Array:  # one buffer each, because the session donates them
        return jnp.zeros(shape, dtype)

    touch = config.sector_fov == "whiskers"
    levels = touch and config.images == "heights"
    learned = (groups, LEVELS, LEVELS) if levels else packed_shape(size) if touch else (0, 0, 0)
    return Memory(
        view=jnp.zeros((size, capacity), jnp.int32) if levels else zeros(size, capacity),
        label=jnp.full(capacity, -1, jnp.int32),
        **{name: zeros(capacity) for name in ("x", "y", "heading", "cosine", "sine")},
        count=jnp.int32(0),
        distinct=jnp.int32(0),
        **{name: zeros(3) for name in ("pose", "motion")},
        **{name: zeros() for name in ("length", "turn", "bias", "turn_error", "since", "angle", "scale")},
        likeness=zeros(*learned),
        before=zeros(len(sector_shifts(config)), capacity if touch else 0),
    )
