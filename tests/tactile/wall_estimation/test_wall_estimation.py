"""Strain templates of constructed walls and signals by place of contact; wall directions from contacts and
strain of walls and posts; from the Create's reports to observations: motion, contacts and walls."""

from copy import deepcopy

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tactile.base.errors import InputError
from tactile.base.random_streams import stream
from tactile.base.se2 import compose
from tactile.base.types import MotionKind, Odometry, Report, StepEnd
from tactile.wall_estimation import estimators
from tactile.wall_estimation import strain_templates as strains
from tactile.wall_estimation.estimators import Wall, WallContact, wall_normal
from tactile.wall_estimation.report_frontend import ReportFrontend, ReportFrontendConfig
from tactile.wall_estimation.signal_map import fit_signal_map
from tactile.wall_estimation.strain_templates import StrainTemplates, TemplateTraining, filter_strain

# Made-up strain of four tapered whiskers against flat walls and posts, in closed form, no simulator.
RATE, SPEED, CONTACT = 2000.0, 0.02, 2e-4
TIME = np.arange(4000) / RATE
FEELERS = ReportFrontendConfig().feelers
POINTING = np.arctan2(*FEELERS.direction.T[::-1])
LENGTH = 0.14
TAPER = (1 - 0.3 / 1.45) / LENGTH
STIFF = 3 * 0.725e-3  # strain a radian and 1/m


def wall(angle: float, random: np.random.Generator | None = None, *, first: int | None = None) -> np.ndarray:
    """[T, W, 2] from first contact on, at a wall of that direction (rad in base_link), which is endless, or
    long enough for the whisker `first` alone; with noise where a stream is given."""
    normal = np.array([np.sin(angle), -np.cos(angle)])
    beta = angle - POINTING
    nearer, side = np.minimum(beta, np.pi - beta), np.where(beta < np.pi / 2, 1, -1)
    there = np.arange(4) == first if first is not None else np.ones(4, bool)
    room = FEELERS.base @ normal + LENGTH * np.sin(beta)  # from the wall to the middle, tips just touching

    def strain(distance: np.ndarray) -> np.ndarray:
        gap = np.clip((distance[:, None] - FEELERS.base @ normal) / LENGTH, -1.0, 1.0)
        slant = np.minimum(np.arcsin(gap), nearer)
        turn = np.where((nearer > 0) & there, nearer - slant, 0.0)
        across = STIFF * (1 / LENGTH - TAPER) * side * turn
        down = 0.08 * across - 0.15 * np.abs(across) * np.tan(np.minimum(slant + 0.2, 1.3))
        return np.stack([across, down], axis=-1)

    far = float(room[there & (nearer > 0)].max())
    approach = far - np.linspace(0, 0.05, 5001)
    hit = approach[np.argmax(np.abs(strain(approach)[..., 0]).max(axis=1) > CONTACT)]
    read = strain(hit - SPEED * np.sin(angle) * TIME)
    return read if random is None else read + 4e-6 * random.standard_normal(read.shape)


def post(whisker: int, along: float) -> np.ndarray:
    """[T, W, 2] as one whisker is bent about a post that it met so far along its shaft, m."""
    away = along * FEELERS.direction[whisker] - np.outer(0.05 * np.arange(200) / 200 + 1e-6, [1.0, 0.0])

    def strain(away: np.ndarray) -> np.ndarray:
        reach = np.linalg.norm(away, axis=1)
        turn = np.arctan2(away[:, 1], away[:, 0]) - POINTING[whisker]
        return np.where(reach < LENGTH, STIFF * (1 / reach - TAPER) * turn, 0.0)

    begun = away[np.argmax(np.abs(strain(away)) > CONTACT)]
    across = strain(begun - np.outer(SPEED * TIME, [1.0, 0.0]))
    read = np.zeros((len(TIME), 4, 2))
    read[:, whisker] = np.stack([across, 0.08 * across - 0.05 * np.abs(across)], axis=-1)
    return read


def report(
    moment: StepEnd = StepEnd.FREE,
    *,
    motion: MotionKind = MotionKind.FORWARD,
    contact: tuple[int, ...] = (),
    strain: np.ndarray | None = None,
    odometry: Odometry | None = None,
) -> Report:
    """A report; that of FWD2 if it has strain."""
    strain = np.zeros((0, 4, 2)) if strain is None else strain
    seconds, time = len(strain) / RATE, np.arange(len(strain)) / RATE
    driven = Odometry(SPEED * seconds, 0.0, 0.0, seconds) if seconds else Odometry(0.025, 0, 0, 0.5)
    touched = np.isin(np.arange(4), contact)
    return Report(odometry or driven, int(motion), int(moment), np.ones(4, bool), touched, time, strain)


def met(strain: np.ndarray, share: float = 0.4) -> tuple[Report, Report]:
    """HIT1 of the first whisker in that strain and its successor: HIT2 when a second whisker touches, ABORT
    if none does within `share` of the strain."""
    level = np.abs(strain[..., 0]) > CONTACT
    ever = np.logical_or.accumulate(level, axis=0)
    first = int(np.abs(strain[0, :, 0]).argmax())
    second = np.flatnonzero(ever.sum(axis=1) > 1)
    last = round(share * len(strain))
    hit = len(second) > 0 and second[0] < last
    end = max(int(second[0]), 200) if hit else last
    now = tuple(np.flatnonzero(ever[end]).tolist())
    slow = report(StepEnd.HIT2 if hit else StepEnd.ABORT, contact=now, strain=strain[:end])
    return report(StepEnd.HIT1, contact=(first,)), slow


def apart(one: float, other: float) -> float:
    """Degrees between two directions, which repeat after half a turn."""
    return float(abs((np.degrees(one - other) + 90) % 180 - 90))


TRAINING, EVERY = TemplateTraining(), np.ones(4, bool)


@pytest.fixture(scope="module")
def drives():
    random = stream(0, "training")
    return [wall(angle, random) for angle in np.repeat(TRAINING.angles, TRAINING.repeats)]


@pytest.fixture(scope="module")
def templates(drives):
    return strains.train_templates(TRAINING, drives)


def test_the_papers_fifteen_angles(templates):
    np.testing.assert_allclose(np.degrees(templates.angle), np.arange(20, 161, 10))
    assert templates.mean.shape == (15, 4000, 4, 2)
    # The noise is that of one filtered drive, not of the mean of four.
    quiet = np.std(filter_strain(TRAINING, 4e-6 * stream(1, "noise").standard_normal((4000, 4, 2)))[400:])
    np.testing.assert_allclose(np.median(templates.spread), quiet, rtol=0.08)


@given(st.integers(0, 99), st.integers(1, 3999), st.floats(-1, 1))
def test_the_filter_is_causal_uses_every_sample_and_starts_in_its_steady_state(seed, cut, level):
    strain = stream(seed, "strain").standard_normal((4000, 2))
    whole = filter_strain(TRAINING, strain)
    np.testing.assert_allclose(filter_strain(TRAINING, strain[:cut]), whole[:cut], atol=1e-12)
    strain[cut:] += 1.0
    assert np.array_equal(filter_strain(TRAINING, strain)[:cut], whole[:cut])
    assert (filter_strain(TRAINING, strain)[-1] != whole[-1]).any()
    np.testing.assert_allclose(filter_strain(TRAINING, np.full((cut, 4, 2), level)), level, atol=1e-9)


def test_the_filter_passes_signals_below_its_cutoff():
    for frequency, least, most in ((2.0, 0.95, 1.01), (17.0, 0.65, 0.75), (60, 0, 0.1)):
        wave = np.sin(2 * np.pi * frequency * np.arange(8000) / RATE)
        assert least < np.abs(filter_strain(TRAINING, wave)[4000:]).max() < most


def test_every_drive_matches_its_own_template(templates):
    random = stream(5, "held out")
    for k, angle in enumerate(templates.angle):
        read = filter_strain(TRAINING, wall(float(angle), random))[:1600]
        match = strains.match_template(templates, read, EVERY)
        assert (match.error.argmin(), match.angle) == (k, angle)
        assert match.relative < 0.03
        # Eq. 5: the mean over the samples so far of the sum over channels.
        by_hand = [((read - mean[:1600]) ** 2).sum() / 1600 for mean in templates.mean]
        np.testing.assert_allclose(match.error, by_hand)


def test_the_parabola_is_nearer_than_the_winner(templates):
    off = []
    for angle in np.radians([63.0, 67.0, 83.0, 97.0, 117.0, 122.0]):
        match = strains.match_template(templates, filter_strain(TRAINING, wall(angle))[:1600], EVERY)
        off.append((apart(match.angle, angle), apart(match.refined, angle)))
        assert abs(match.refined - match.angle) <= np.radians(TRAINING.step_deg)
    winner, refined = np.mean(off, axis=0)
    assert refined < 0.5 * winner


def test_dead_whiskers_are_left_out_of_the_match(templates):
    read = filter_strain(TRAINING, wall(np.radians(110.0)))[:1600]
    broken, use = read.copy(), np.arange(4) < 3
    broken[:, 3] = 1.0
    errors = [strains.match_template(templates, one, use).error.tolist() for one in (broken, read)]
    assert errors[0] == errors[1]
    assert strains.match_template(templates, broken, EVERY).relative > 0.5


def written(path, templates):
    templates.write(path)
    return path.read_bytes()


def test_templates_read_back_equal(templates, tmp_path):
    written(tmp_path / "templates.npz", templates)
    np.testing.assert_equal(StrainTemplates.read(tmp_path / "templates.npz"), templates)


FILES = {
    "none": lambda path, templates: None,
    "empty": lambda path, templates: path.write_bytes(b""),
    "text": lambda path, templates: path.write_text("not a file of templates"),
    "other arrays": lambda path, templates: np.savez(path, other=np.zeros(3)),
    "one array": lambda path, templates: path.write_bytes(b"\x93NUMPY" + bytes(200)),
    "a folder": lambda path, templates: path.mkdir(),
    "another version": lambda path, templates: np.savez(
        path, strain_templates=99, training="{}", angle=[0.0], mean=[0.0], spread=[0.0]
    ),
    "truncated": lambda path, templates: path.write_bytes(written(path, templates)[:9999]),
    "another shape": lambda path, templates: templates._replace(mean=templates.mean[:14]).write(path),
}


@pytest.mark.parametrize("kind", FILES)
def test_other_files_are_refused(kind, tmp_path, templates):
    FILES[kind](tmp_path / "wrong.npz", templates)
    with pytest.raises(InputError, match=r"wrong\.npz: .*reproduce templates"):
        StrainTemplates.read(tmp_path / "wrong.npz")


def test_unfit_drives_are_refused(drives):
    for unfit, message in ((drives[5][:3800], r"drive 1 at 30.*1\.9 s"), (np.nan * drives[5], "NaN samples")):
        with pytest.raises(InputError, match=message):
            strains.train_templates(TRAINING, [*drives[:5], unfit, *drives[6:]])


def test_unsound_settings_are_refused():
    for unsound in ({"repeats": 1}, {"cutoff": 1000.0}, {"first_deg": 90.0, "last_deg": 80.0}):
        with pytest.raises(ValueError, match=next(iter(unsound))):
            TemplateTraining(**unsound)


BASE, REST = np.array([0.01, -0.02, 0.005]), np.radians(60.0)


def at(reach, turn, rise):
    """Positions [N, 3] at distances from the base (m), bent by `turn` and raised by `rise` (rad)."""
    angle, flat = REST - turn, reach * np.cos(rise)
    return BASE + np.stack([-flat * np.cos(angle), -flat * np.sin(angle), reach * np.sin(rise)], axis=-1)


def signals(position):
    """A whisker whose signals fall with the distance of the contact, each at its own rate."""
    away = position - BASE
    reach = np.linalg.norm(away, axis=1)
    turn = REST - np.arctan2(-away[:, 1], -away[:, 0])
    size = 1.0 - reach / 0.07
    across, along = 3000.0 * turn * size, 2000.0 * turn * (1.0 - reach / 0.05)
    return np.stack([3000.0 * np.arcsin(away[:, 2] / reach) * size, across, along], axis=-1)


def test_a_signal_map_meets_held_out_places_and_leaves_out_rows_that_contradict_their_neighbours():
    reach, turn = np.linspace(0.012, 0.042, 8), np.radians(np.arange(0, 61, 10))
    grid = np.meshgrid(reach, turn, [-0.2, -0.1, 0, 0.1, 0.2])
    position, random = at(*(axis.ravel() for axis in grid)), np.random.default_rng(1)
    inside = at(random.uniform(0.02, 0.04, 50), random.uniform(0.1, 0.9, 50), random.uniform(-0.15, 0.15, 50))
    error = np.abs(fit_signal_map(position, signals(position), BASE)(inside) - signals(inside))
    assert np.median(error) < 0.01 * np.median(np.abs(signals(inside)))
    signal = signals(position)
    signal[120] = 0.0  # the whisker slipped off
    found = fit_signal_map(position, signal, BASE)(position[120:121])
    np.testing.assert_allclose(found, signals(position[120:121]), atol=0.02 * np.abs(signal).max())
    with pytest.raises(InputError, match="5 rows"):
        fit_signal_map(np.ones((5, 3)), np.ones((5, 3)), BASE)


POINTS = estimators.contact_points(FEELERS, 0.13)


@pytest.fixture(scope="module")
def tip(templates):
    return strains.fit_tip_model(templates, FEELERS)


def meeting(strain, **changes):
    hit, slow = met(strain)
    travel, moment = np.array(slow.odometry[:3], float), StepEnd(slow.moment)
    strain = filter_strain(TRAINING, slow.strain)
    there = WallContact(hit.contact, slow.contact, travel, moment, strain, np.ones(4, bool))
    return there._replace(**changes)


def is_none(wall):
    return not wall.known and wall.direction == 0 and wall.sd == 0 and not wall.point.any()


@given(st.floats(-9, 9), st.floats(-1, 1), st.floats(-1, 1))
def test_the_point_is_the_nearest_of_the_line_through(direction, x, y):
    through_it = Wall.through(np.array([x, y]), direction, 0.1)
    along = np.array([np.cos(direction), np.sin(direction)])
    assert 0 <= through_it.direction < np.pi
    assert apart(through_it.direction, direction) < 1e-9
    assert abs(through_it.point @ along) < 1e-12
    off = np.array([x, y]) - through_it.point
    assert abs(off[0] * along[1] - off[1] * along[0]) < 1e-12


@given(st.floats(0.02, np.pi - 0.02), st.integers(0, 3), st.integers(0, 3), st.floats(-0.03, 0.03))
def test_two_contacts_give_the_line_through_them_with_the_motion_between(angle, first, second, ahead):
    """A wall through the first contact; the robot then moves until the second one is on it too."""
    normal, travel, hits = wall_normal(angle), np.array([ahead, 0.02, 0.1]), np.eye(4, dtype=bool)
    there = meeting(wall(1.2), travel=travel).to_final_frame(POINTS)
    travel[:2] += normal * ((there[second] - there[first]) @ normal)
    both = hits[second] | hits[first]
    two = meeting(wall(1.2), first=hits[first], now=both, travel=travel, moment=StepEnd.HIT2)
    found, where = estimators.geometric_wall(POINTS, two), two.to_final_frame(POINTS)[first]
    if first == second or np.linalg.norm(where - POINTS[second]) < 0.05:
        assert is_none(found)
        return
    line, normal = POINTS[second] - where, wall_normal(found.direction)
    assert apart(found.direction, float(np.arctan2(line[1], line[0]))) < 1e-6
    np.testing.assert_allclose([where @ normal, POINTS[second] @ normal], found.point @ normal)
    assert is_none(estimators.geometric_wall(POINTS, two._replace(moment=StepEnd.ABORT)))


def test_the_matched_wall_passes_through_the_first_contact(templates):
    for angle in np.radians([30.0, 90.0, 150.0]):
        there = meeting(wall(angle))
        match = strains.match_template(templates, there.strain, EVERY)
        found = estimators.template_wall(POINTS, match, there, 0.3)
        assert apart(found.direction, angle) < 0.1
        at = POINTS[there.first_whisker()] - [there.travel[0], 0]
        np.testing.assert_allclose(found.point, (wall_normal(angle) @ at) * wall_normal(angle), atol=1e-9)
        unlike = match._replace(relative=0.31)
        assert is_none(estimators.template_wall(POINTS, unlike, there, 0.3))
        assert estimators.template_wall(POINTS, unlike, there, None).known


@pytest.mark.parametrize("angle", np.arange(25.0, 156.0, 10.0))
def test_directions_of_flat_walls_are_within_a_degree_also_after_abort(tip, angle):
    angle = np.radians(angle)
    for seed in range(2):
        there = meeting(wall(angle, stream(seed, "noise")))
        found = estimators.fused_wall(tip, POINTS, there)
        assert found.known
        assert apart(found.direction, angle) < 1.5
        assert 0 < found.sd < estimators.MAX_DIRECTION_SD
        # The wall passes through the first whisker's tip at HIT1, and is nearer by the distance driven.
        tips = FEELERS.base + 0.14 * FEELERS.direction
        left = wall_normal(angle) @ tips[there.first_whisker()]
        left -= len(there.strain) / RATE * SPEED * np.sin(angle)
        assert left - 0.013 < np.linalg.norm(found.point) < left + 0.003


@pytest.mark.parametrize(("whisker", "angle"), [(0, 93.0), (3, 87.0), (3, 100.0), (1, 140.0), (2, 40.0)])
def test_a_short_wall_is_estimated_from_its_first_whisker(tip, templates, whisker, angle):
    there = meeting(wall(np.radians(angle), stream(1, "noise"), first=whisker))
    assert there.first_whisker() == whisker
    assert apart(estimators.fused_wall(tip, POINTS, there).direction, np.radians(angle)) < 4
    # The nearest template is of another wall.
    assert apart(strains.match_template(templates, there.strain, EVERY).angle, np.radians(angle)) > 8


def test_a_post_gives_no_wall(tip):
    for whisker in range(4):
        for along in (0.05, 0.07, 0.09, 0.11):
            assert is_none(estimators.fused_wall(tip, POINTS, meeting(post(whisker, along))))


def test_a_large_turn_at_first_contact_gives_no_wall(tip):
    there = meeting(wall(np.radians(30.0)))
    whole = filter_strain(TRAINING, wall(np.radians(30.0)))
    level = np.abs(whole[:, 3, 0]) / tip.gain
    for start, known in ((0.15, True), (0.21, False)):
        late = there._replace(strain=whole[level > start])
        assert len(late.strain) > 800
        assert estimators.fused_wall(tip, POINTS, late).known is known


def test_without_strain_there_is_no_estimate(tip):
    there, none = meeting(wall(1.2)), np.zeros(4, bool)
    for strain in (there.strain[:0], there.strain[:30], 0 * there.strain):
        assert is_none(estimators.fused_wall(tip, POINTS, there._replace(strain=strain)))
    for lacking in ({"first": none}, {"alive": none}):
        assert is_none(estimators.fused_wall(tip, POINTS, there._replace(**lacking)))


def test_a_contradicting_second_contact_does_not_turn_the_wall(tip):
    there = meeting(wall(np.radians(40.0)), moment=StepEnd.HIT2)
    for other in np.eye(4, dtype=bool)[:3]:
        crossed = there._replace(now=other | there.first)
        assert apart(estimators.fused_wall(tip, POINTS, crossed).direction, np.radians(40.0)) < 1.5


def test_the_fitted_model_is_that_of_the_constructed_whiskers(tip, templates):
    assert tip.gain == pytest.approx(3 * 0.725e-3 * (1 / 0.14 - (1 - 0.3 / 1.45) / 0.14), rel=0.01)
    assert tip.crosstalk == pytest.approx(0.08, abs=0.01)
    known = [0.0032137523, 0.0799741426, 0.0372890, 0.2774918, 0.5645813]
    np.testing.assert_allclose([tip.gain, tip.crosstalk, *tip.share[[0, 6, 12]]], known, rtol=1e-5)
    assert tip.time[[0, -1]].tolist() == pytest.approx([0.02, 2.0])
    found = [estimators.fused_wall(tip, POINTS, meeting(wall(np.radians(angle)))) for angle in (40.0, 110.0)]
    np.testing.assert_allclose([one.sd for one in found], [0.0421603, 0.0410826], rtol=1e-4)
    points = [[0.164031, -0.195484], [0.240654, 0.087591]]
    np.testing.assert_allclose([one.point for one in found], points, atol=1e-5)
    three = type(FEELERS)(*(part[:3] for part in FEELERS))
    turned = FEELERS._replace(direction=FEELERS.direction @ np.array([[0.8, -0.6], [0.6, 0.8]]))
    for known, feelers, message in (
        (templates, three, "4 whiskers"),
        (templates._replace(mean=0 * templates.mean), FEELERS, "hardly any contact"),
        (templates, turned, "check mounts"),
    ):
        with pytest.raises(InputError, match=message):
            strains.fit_tip_model(known, feelers)


ANGLE = np.radians(70.0)
HIT, SLOW = met(wall(ANGLE))
BACK, TURN = report(motion=MotionKind.BACK), report(motion=MotionKind.TURN)


@pytest.fixture(scope="module")
def fused(templates):
    """A front end with templates, which has seen nothing; to be copied."""
    return ReportFrontend(ReportFrontendConfig(), templates)


def frontend(**config):
    return ReportFrontend(ReportFrontendConfig(**config))


def observe(reporting, *reports):
    copied = deepcopy(reporting)
    seen = [copied.observe(one) for one in reports]
    return [one for one in seen if one is not None]


def direction(seen):
    """Direction of the wall, at right angles to the vector to its nearest point."""
    assert seen.wall
    return float(np.arctan2(seen.wall_point[1], seen.wall_point[0]) + np.pi / 2)


@given(st.lists(st.booleans(), min_size=4, max_size=4), st.lists(st.booleans(), min_size=4, max_size=4))
def test_contacts_have_their_contact_points(contact, alive):
    step = report(StepEnd.HIT1)._replace(contact=np.array(contact), alive=np.array(alive))
    (seen,) = observe(frontend(walls="none"), step)
    both = np.array(contact) & np.array(alive)
    assert seen.contact.tolist() == seen.view[0, :, 0].tolist() == both.tolist()
    assert seen.alive.tolist() == alive
    assert seen.view.shape == frontend().view_shape == (1, 4, 1)
    assert seen.view_seen == both.any()
    assert seen.label == -1
    x, y, degrees = np.transpose(ReportFrontendConfig().mounts)
    there = np.column_stack([x + 0.13 * np.cos(np.radians(degrees)), y + 0.13 * np.sin(np.radians(degrees))])
    np.testing.assert_allclose(seen.point, there * both[:, None])


@pytest.mark.parametrize("motion", list(MotionKind))
def test_every_observation_has_the_motion_of_its_step_and_a_back_step_only_that(motion):
    odometry, back = Odometry(0.01, 0.02, 0.3, 0.5), motion == MotionKind.BACK
    (seen,) = observe(frontend(), report(motion=motion, contact=(2,), odometry=odometry))
    assert tuple(seen.odometry) == tuple(odometry)
    assert seen.motion == motion
    assert seen.contact.tolist() == [False, False, not back, False]
    for part in (seen.view_seen, seen.point, seen.view, seen.alive):
        assert np.any(part) != back
    for part in (seen.wall, seen.wall_point, seen.wall_sd):
        assert not np.any(part)


@given(st.lists(st.tuples(*[st.floats(-0.5, 0.5)] * 3, st.booleans()), min_size=1, max_size=12))
def test_fold_back_adds_to_the_next_motion(steps):
    kinds = [MotionKind.BACK if back else MotionKind.TURN for *_, back in steps] + [MotionKind.FORWARD]
    moves = [Odometry(*step[:3], 0.5) for step in steps] + [Odometry(0.025, 0.0, 0.0, 0.5)]
    reports = [report(motion=kind, odometry=move) for kind, move in zip(kinds, moves, strict=True)]

    def path(fold):
        pose, time = np.zeros(3), 0.0
        seen = observe(frontend(fold_back=fold), *reports)
        assert len(seen) == (sum(kind != MotionKind.BACK for kind in kinds) if fold else len(kinds))
        for one in seen:
            pose = compose(pose, np.array(one.odometry[:3]))
            time += one.odometry.dt
        return np.array([*pose, time])

    off = path(True) - path(False)
    assert abs(np.exp(1j * off[2]) - 1) < 1e-9
    np.testing.assert_allclose(off[[0, 1, 3]], 0, atol=1e-9)


@pytest.mark.parametrize(("walls", "within"), [("fused", 1.5), ("template", 0.1)])
def test_walls_are_estimated_at_the_end_of_the_slow_drive(walls, within, templates):
    reporting = ReportFrontend(ReportFrontendConfig(walls=walls), templates)
    for angle in np.radians([40.0, 70.0, 90.0, 130.0]):
        hit, slow = observe(reporting, *met(wall(angle)))
        assert not hit.wall
        assert apart(direction(slow), angle) < within
        assert 0.03 < slow.wall_sd < 0.15
        # The robot is some 2 dm from the wall at the end of the step.
        assert 0.1 < wall_normal(angle) @ slow.wall_point < 0.3


@pytest.mark.parametrize("angle", [80.0, 85.0, 97.0])
def test_without_templates_two_contacts_give_the_wall(angle):
    hit, slow = met(wall(np.radians(angle)), share=1.0)
    assert slow.moment == StepEnd.HIT2
    reporting, plain = frontend(walls="geometric"), frontend()
    _, seen = observe(reporting, hit, slow)
    assert apart(direction(seen), np.radians(angle)) < 6
    assert direction(observe(plain, hit, slow)[1]) == direction(seen)
    for other in (reporting, plain):
        assert not observe(other, hit, slow._replace(moment=int(StepEnd.ABORT)))[1].wall
    assert not observe(frontend(walls="none"), hit, slow)[1].wall


def test_a_slow_drive_of_several_reports_equals_one_report(fused):
    first = report(StepEnd.FREE, contact=(2,), strain=SLOW.strain[:700])
    rest = report(StepEnd(SLOW.moment), strain=SLOW.strain[700:])._replace(contact=SLOW.contact)
    parts = observe(fused, HIT, first, rest)
    assert [bool(one.wall) for one in parts] == [False, False, True]
    np.testing.assert_allclose(parts[-1].wall_point, observe(fused, HIT, SLOW)[-1].wall_point, atol=1e-9)


@pytest.mark.parametrize("after", range(4))
def test_a_restored_front_end_continues_to_the_same_bits(after, templates):
    back = report(motion=MotionKind.BACK, odometry=Odometry(-0.025, 0.01, 0.2, 0.5))
    cut = report(StepEnd.FREE, contact=(2,), strain=SLOW.strain[:700])
    reports = [HIT, cut, SLOW._replace(strain=SLOW.strain[700:]), back, HIT]
    whole = ReportFrontend(ReportFrontendConfig(fold_back=True), templates)
    begun, restored = deepcopy(whole), deepcopy(whole)
    expected = [whole.observe(one) for one in reports]
    assert expected[2].wall
    for one in reports[: after + 1]:
        begun.observe(one)
    restored.observe(HIT)  # forgotten by the restoration
    restored.restore(begun.arrays())
    np.testing.assert_equal([restored.observe(one) for one in reports[after + 1 :]], expected[after + 1 :])


def test_without_hit1_there_is_no_wall(fused):
    for reports in ([SLOW], [HIT, TURN, SLOW], [HIT, BACK, SLOW], [HIT, SLOW, SLOW]):
        assert not observe(fused, *reports)[-1].wall
    # The same reports give the same result after any other reports.
    again = observe(fused, SLOW, report(), TURN, BACK, HIT, SLOW)[-1]
    np.testing.assert_array_equal(again.wall_point, observe(fused, HIT, SLOW)[-1].wall_point)


def test_whiskers_with_nan_do_not_affect_others(fused, templates):
    broken = SLOW.strain.copy()
    broken[100, 0], broken[200, 1] = np.nan, np.inf
    for reporting in (fused, ReportFrontend(ReportFrontendConfig(walls="template"), templates)):
        assert apart(direction(observe(reporting, HIT, SLOW._replace(strain=broken))[-1]), ANGLE) < 1.5
        assert not observe(reporting, HIT, SLOW._replace(strain=SLOW.strain * np.nan))[-1].wall
    lost = SLOW._replace(odometry=Odometry(np.nan, 0.0, 0.0, 1.0))
    assert not observe(fused, HIT, lost)[-1].wall


def test_other_whiskers_and_sample_rates_are_refused(templates, tmp_path):
    with pytest.raises(InputError, match="3 whiskers"):
        frontend().observe(report()._replace(contact=np.zeros(3, bool)))
    with pytest.raises(InputError, match="reproduce templates"):
        frontend(walls="template")
    with pytest.raises(InputError, match=r"nowhere\.npz: no such file"):
        frontend(templates=tmp_path / "nowhere.npz")
    with pytest.raises(ValueError, match="contact_radius"):
        frontend(contact_radius=0.2)
    templates.write(tmp_path / "kept.npz")
    read = frontend(templates=tmp_path / "kept.npz")
    assert observe(read, HIT, SLOW)[-1].wall
    half = SLOW._replace(strain=SLOW.strain[::2], time=SLOW.time[::2])
    with pytest.raises(InputError, match="1000 samples per second; expected 2000"):
        observe(read, HIT, half)
