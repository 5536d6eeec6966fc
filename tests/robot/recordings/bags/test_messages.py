"""Every message type, in every kind of bag, gives its samples; what a description says of a bag reads it."""

import io
import sys

import numpy as np
import pytest
from PIL import Image

from robot.recordings.bags.bag_description import Shape, describe_bag, suggested_topics
from robot.sources.odometry import from_poses, from_velocities
from tactile.base.errors import InputError
from tests.helpers.ros_bags import KINDS, Entry, header, image, odometry, pose, quaternion, scan, transform
from tests.robot.recordings.bags.conftest import PATH, SCANS, START, STEP, TIMES, WHEELS, framed, link, opened

SECONDS = np.array([time / 10**9 for time in TIMES])
LATER = 5_000_000  # ns between a measurement and its receipt


def read(path, told=None, **settings):
    """Reads a bag; unless warnings are told there are none."""
    found = []
    source = opened(path, found if told is None else told, **settings)
    assert found == []
    return source


def stamped(kind, fields):
    heads = [{"header": header(time, "odom")} for time in TIMES]
    return [Entry("/topic", kind, TIMES[row] + LATER, heads[row] | fields(row)) for row in range(12)]


@pytest.mark.parametrize("little_endian", [True, False])
@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_of_bag_gives_the_same_rows(kind, little_endian, write):
    if kind.startswith("ros1") and not little_endian:
        return
    source = read(write(WHEELS, SCANS, kind=kind, little_endian=little_endian), views="/scan")
    assert np.array_equal(source.time, SECONDS)
    assert source.motion == pytest.approx(from_poses(SECONDS, PATH), abs=1e-12)
    assert source.views[4].ravel() == pytest.approx(np.arange(1, 19) * 0.25 / 8)
    assert source.seen.all()


POSES = {
    "PoseStamped": lambda row: {"pose": pose(*PATH[row])},
    "PoseWithCovarianceStamped": lambda row: {"pose": {"pose": pose(*PATH[row])}},
    "TransformStamped": lambda row: {
        "transform": transform(0, "", "", *PATH[row][:2], quaternion(PATH[row][2]))["transform"]
    },
}


@pytest.mark.parametrize("kind", POSES)
def test_poses_are_odometry_and_truth_by_the_clock_of_the_header_or_of_the_bag(kind, write):
    entries = stamped(f"geometry_msgs/msg/{kind}", POSES[kind])
    source = read(write(entries, kind="ros1"), odometry="topic", truth="topic")
    assert np.array_equal(source.time, SECONDS)
    assert source.motion == pytest.approx(from_poses(SECONDS, PATH), abs=1e-12)
    assert source.truth == pytest.approx(PATH)
    source = read(write(entries), odometry="/topic", clock="bag")
    assert np.array_equal(source.time, [(time + LATER) / 10**9 for time in TIMES])


def test_velocities_hold_since_the_message_before(write):
    rates = np.column_stack([0.1 * np.arange(12), np.full(12, 0.05), np.full(12, 0.3)])
    expected = from_velocities(SECONDS, *rates.T)

    def fields(row):
        forward, left, turn = rates[row].tolist()
        return {"twist": {"linear": {"x": forward, "y": left}, "angular": {"z": turn}}}

    source = read(write(stamped("geometry_msgs/msg/TwistStamped", fields)), odometry="/topic")
    assert np.array_equal(source.motion, expected)
    wheels = [odometry(time, 0, 0, 0, tuple(rate)) for time, rate in zip(TIMES, rates.tolist(), strict=True)]
    source = read(write(wheels, kind="sqlite3"), odometry={"topic": "/odom", "use": "twist"})
    assert np.array_equal(source.motion, expected)


def test_several_messages_can_make_one_sample(write):
    source = read(write(WHEELS), odometry={"topic": "/odom", "every": 4})
    assert np.array_equal(source.time, SECONDS[::4])
    assert source.motion == pytest.approx(from_poses(SECONDS[::4], PATH[::4]), abs=1e-12)


def test_frames_are_odometry_and_truth(write):
    """odom to base_link at 10 Hz; map to odom drifts at a third of the rate; base_link is a child of base."""
    drift = np.array([[0.3 * number, 0.0, np.pi / 2] for number in range(4)])
    entries = [*framed("odom", "base"), *framed("map", "odom", drift, TIMES[::3])]
    entries.append(link("base", "base_link", x=0.5))
    source = read(write(entries), odometry={"tf": ["odom", "base"]}, truth={"tf": ["map", "base_link"]})
    assert source.motion == pytest.approx(from_poses(SECONDS, PATH), abs=1e-12)
    ahead = PATH[:, :2] + 0.5 * np.column_stack([np.cos(PATH[:, 2]), np.sin(PATH[:, 2])])
    assert source.truth[:10, 0] == pytest.approx((0.1 * np.arange(12) - ahead[:, 1])[:10], abs=1e-6)
    assert source.truth[:10, 1] == pytest.approx(ahead[:10, 0])
    assert source.truth[:10, 2] == pytest.approx(PATH[:10, 2] + np.pi / 2)
    assert np.isnan(source.truth[10:]).all()  # after the last transform of map to odom
    upwards = read(write(entries, kind="ros1"), odometry={"tf": ["base", "odom"]})
    assert upwards.motion[:, 2] == pytest.approx(-source.motion[:, 2])


def test_touch_of_joints_named_in_any_order(write):
    def fields(row):
        names = ["wheel", "left", "right"] if row % 2 else ["right", "wheel", "left"]
        values = {"wheel": 40.0, "left": 0.1 * row, "right": 1.0}
        return {"name": names, "position": [0.0] * 3, "effort": [values[name] for name in names]}

    kind = "sensor_msgs/msg/JointState"
    other = [Entry("/topic", kind, START + 1, {"header": header(START), "name": ["wheel"]})]
    touch = {"topic": "/topic", "use": "effort", "joints": ["left", "right"], "high": 2.0, "columns": 2}
    source = read(write(WHEELS, stamped(kind, fields), other), touch=touch)
    assert (source.view_shape, source.whiskers) == ((1, 2, 1), 2)
    assert source.views[3].ravel() == pytest.approx([0.15, 0.5])


@pytest.mark.parametrize("number", [32, 64])
def test_touch_of_arrays_by_their_layout(number, write):
    layout = {"dim": [{"label": "ring", "size": 2}, {"label": "whisker", "size": 3}], "data_offset": 1}
    fields = {"layout": layout, "data": [9, 1, 2, 3, 4, 5, 6]}
    arrays = [Entry("/skin", f"std_msgs/msg/Float{number}MultiArray", time, fields) for time in TIMES]
    path = write(WHEELS, arrays)
    source = read(path, touch={"topic": "/skin", "low": 1.0, "high": 6.0})
    assert source.views[2, :, :, 0] == pytest.approx(np.array([[0.0, 0.2, 0.4], [0.6, 0.8, 1.0]]))
    assert source.whiskers == 6
    views = read(path, touch={"topic": "/skin", "rows": 3, "high": 6.0}, samples="views")
    assert (views.length, views.view_shape) == (12, (3, 2, 1))


def test_views_faster_than_the_odometry_can_be_the_samples(write):
    moments = range(START - STEP, TIMES[-1], STEP // 4)
    path, told = write(WHEELS, [scan(t, np.full(18, 1.0), -1.5, 0.1) for t in moments]), []
    source = read(path, told, views="/scan", samples="views")
    assert source.length == 44
    assert source.seen.all()
    assert np.hypot(*source.motion[1:, :2].T) == pytest.approx(np.hypot(0.1, 0.02) / 4, rel=1e-4)
    assert source.motion[:, 2].sum() == pytest.approx(0.05 * (11 - 0.25))
    assert len(told) == 1
    assert "/scan: 4 of 48 views" in told[0]
    assert read(path, told, views="/scan").seen.sum() == 12
    assert "farther from their sample than another" in told[-1]


def test_the_topics_of_openratslam_are_a_preset(write):
    wheels = [odometry(time, 0, 0, 0, (0.5, 0, 0))._replace(topic="/irat_red/odom") for time in TIMES]
    grey = np.full((24, 80), 51, np.uint8)
    images = [image(time, grey, topic="/irat_red/camera/image") for time in TIMES]
    source = read(write(wheels, images), odometry=None, openratslam="irat_red")
    assert source.motion[5, 0] == pytest.approx(0.05)
    assert source.view_shape == (12, 60, 1)
    assert source.views[5] == pytest.approx(0.2)


@pytest.mark.parametrize("stored", ["ros1", "mcap"])
def test_a_camera_alone_gives_views_and_odometry(stored, write):
    """Compressed images, as OpenRatSLAM's users record them, of a turn by 6 degrees to the left a step."""
    scene = np.random.default_rng(1).integers(0, 255, 120, dtype=np.uint8)

    def fields(row):
        file = io.BytesIO()
        Image.fromarray(np.tile(np.roll(scene, 2 * row), (24, 1))).save(file, "PNG")
        return {"format": "png", "data": np.frombuffer(file.getvalue(), np.uint8)}

    path = write(stamped("sensor_msgs/msg/CompressedImage", fields), kind=stored)
    camera = {"visual_odometry": {"fov_deg": 360}, "image": {"rows": 2, "columns": 12}}
    source = read(path, **camera, odometry=None, views="/topic")
    assert (source.length, source.view_shape) == (12, (2, 12, 1))
    assert np.array_equal(source.time, SECONDS)
    assert np.rad2deg(source.motion[1:, 2]) == pytest.approx(6.0)
    blocks = np.roll(scene, 6).reshape(12, 10).mean(axis=1) / 255
    assert source.views[3, :, :, 0] == pytest.approx(np.tile(blocks, (2, 1)))


def test_a_missing_library_is_named(write, monkeypatch):
    path = write(WHEELS)
    monkeypatch.setitem(sys.modules, "rosbags", None)
    with pytest.raises(InputError, match=r"rosbags: not installed; pip install 'ratslam\[ros\]'"):
        read(path)


@pytest.mark.parametrize("named", [True, False])
@pytest.mark.parametrize("topic", ["/tf_static", "/robot/tf_static", "/tf"])
def test_a_ring_is_mounted_by_the_frames(named, topic, write):
    """A laser that looks to the left, on a plate on the robot; something near is on its axis."""
    child = {"child_frame_id": "/base_link" if named else ""}
    wheels = [entry._replace(fields=dict(entry.fields) | child) for entry in WHEELS]
    ranges = np.full(360, 4.0)
    ranges[140:220] = 1.0
    links = [link(*frames, np.pi / 4, 0.1, topic) for frames in (("base_link", "plate"), ("plate", "laser"))]
    path = write(links, wheels, [scan(time, ranges, -np.pi, np.pi / 180) for time in TIMES])
    view = {"topic": "/scan", "rows": 1, "columns": 4, "max_range": 4.0}
    assert np.flatnonzero(read(path, views=view).views[3].ravel() < 0.9).tolist() == [2, 3]
    told = []
    other = read(path, told, views=view, body="somewhere")
    assert np.flatnonzero(other.views[3].ravel() < 0.9).tolist() == [1, 2]
    assert "no transform from somewhere to laser" in told[0]


MOMENTS = [START + STEP * row for row in range(20)]
DRIVE = [odometry(time, 0.1 * row, 0.0, 0.05 * row, (1.0, 0.0, 0.5)) for row, time in enumerate(MOMENTS)]
FANS = [scan(time, [np.inf, np.nan, 2.0, 2.0], -0.2, 0.1, range_max=30.0) for time in MOMENTS[::2]]


def series(topic, kind, fields):
    return [Entry(topic, kind, time, fields(row, time)) for row, time in enumerate(MOMENTS)]


def along(parent, child):
    return framed(parent, child, np.column_stack([0.1 * np.arange(20), np.zeros(20), np.zeros(20)]), MOMENTS)


SKIN = series("/skin", "std_msgs/msg/Float64MultiArray", lambda row, _: {"data": [200.0, 900.0 + row]})
TRUE = series("/mocap/pose", "geometry_msgs/msg/PoseStamped",
              lambda _, time: {"header": header(time), "pose": pose(0, 0, 0)})  # fmt: skip
FRAMES = along("odom", "base_link")
IMAGES = [image(time, np.full((12, 60), 7, np.uint8)) for time in range(START, MOMENTS[-1], STEP // 3)]


def test_topics_are_described(write):
    custom = [Entry("/lab", "lab_msgs/msg/Custom", time, {}) for time in MOMENTS[:3]]
    bag = describe_bag(write(DRIVE, FANS, SKIN, IMAGES, FRAMES, custom))
    topics = {topic.name: topic for topic in bag.topics}
    assert {name: topic.roles for name, topic in topics.items()} == {
        "/image": ("views",), "/lab": (), "/odom": ("odometry", "truth"), "/scan": ("views",),
        "/skin": ("touch",), "/tf": (),
    }  # fmt: skip
    shapes = {name: topic.shape or Shape("") for name, topic in topics.items()}
    assert shapes["/scan"][:2] == ("4 beams over 23 degrees, median 2 m, 25% empty", (4,))
    assert (shapes["/scan"].high, shapes["/scan"].wider) == (30.0, False)
    assert shapes["/scan"].extent == pytest.approx((-0.05, 0.4, 0.1))
    assert shapes["/image"][:2] == ("60 x 12 mono8, mean grey 7", (60, 12))
    assert shapes["/skin"][:4] == ("2 values from 200 to 919", (2,), 200.0, 919.0)
    assert (topics["/lab"].total, topics["/lab"].shape) == (3, None)
    wheels = topics["/odom"]
    assert (wheels.frame, wheels.child, wheels.total) == ("odom", "base_link", 20)
    assert (wheels.stamped.rate_hz, wheels.stamped.gap) == (10.0, 0.1)
    assert (shapes["/odom"].pose_path, shapes["/odom"].twist_path) == pytest.approx((1.9, 1.9))
    assert bag.links == (("odom", "base_link", False, 20),)


def test_faults_of_a_topic_are_described(write):
    spoilt = [entry._replace(topic="/bad", fields=entry.fields | {"encoding": "yuv"}) for entry in IMAGES]
    stamps = [MOMENTS[0], 0, MOMENTS[5], MOMENTS[5], MOMENTS[2], MOMENTS[15]]
    disorder = [odometry(stamp, 0, 0, 0)._replace(time=MOMENTS[k]) for k, stamp in enumerate(stamps)]
    topics = {topic.name: topic for topic in describe_bag(write(spoilt, disorder)).topics}
    assert topics["/bad"].roles == ()
    assert "encoding 'yuv'" in topics["/bad"].fault
    found = topics["/odom"].stamped
    assert (found.zero, found.repeated, found.backwards, found.in_order) == (1, 1, 2, False)
    assert found.gap == pytest.approx(START / 1e9 + 0.5)


RAYS = {"topic": "/scan", "rows": 1, "columns": 4}
STILL = [odometry(time, 0, 0, 0, (1.0, 0.0, 0.5)) for time in MOMENTS]
UNSTAMPED = [odometry(0, 0.1 * row, 0, 0)._replace(time=time) for row, time in enumerate(MOMENTS)]
BEFORE_B = [FANS[0]._replace(fields=dict(FANS[0].fields) | {"header": header(START, "b/laser")})]
TWO = [along("a_odom_combined", "a_base"), along("b/odom", "b/base_link"), BEFORE_B]
ROBOT = ["robot1/odom", "robot1/base_footprint"]
SUGGESTED = {
    "scan": ([DRIVE, FANS, IMAGES, TRUE], {"odometry": "/odom", "views": RAYS, "truth": "/mocap/pose"}),
    "images": ([DRIVE, IMAGES], {"odometry": "/odom", "views": "/image", "samples": "views"}),
    "touch": ([DRIVE, SKIN], {"odometry": "/odom", "touch": {"topic": "/skin", "low": 200.0, "high": 919.0}}),
    "frames": ([FRAMES, FANS], {"odometry": {"tf": ["odom", "base_link"]}, "views": RAYS}),
    "frames of a robot": ([along(*ROBOT), FANS], {"odometry": {"tf": ROBOT}, "views": RAYS}),
    "frames of two": (TWO, {"odometry": {"tf": ["b/odom", "b/base_link"]}, "views": RAYS}),
    "frames of none": ([along("map", "odom"), along("a/odom", "b/base_link"), FANS], {}),
    "scans that vary": ([DRIVE, FANS[:1], [scan(MOMENTS[5], [2.0] * 24, -0.6, 0.05)]],
                        {"odometry": "/odom", "views": RAYS | {"columns": 14, "span": [-0.625, 0.575]}}),
    "velocities": ([STILL], {"odometry": {"topic": "/odom", "use": "twist"}}),
    "no stamps": ([UNSTAMPED], {"odometry": "/odom", "clock": "bag"}),
    "nothing": ([FANS], {}),
}  # fmt: skip


@pytest.mark.parametrize(("parts", "expected"), SUGGESTED.values(), ids=SUGGESTED.keys())
def test_suggested_settings_read_the_bag(parts, expected, write):
    path = write(*parts)
    topics = suggested_topics(describe_bag(path))
    assert topics == expected
    if topics:
        assert len(opened(path, **topics).time) >= 20


def bumper(time, *frames):
    detections = [{"header": header(time, frame), "type": 1} for frame in frames]
    fields = {"header": header(time), "detections": detections}
    return Entry("/hazards", "irobot_create_msgs/msg/HazardDetectionVector", time, fields)


def test_hazards_proximity_and_bumpers_of_a_create_are_touch_by_the_names_of_their_sensors(write):
    pressed = {
        3: ("bump_left",),
        5: ("bump_right", "cliff_side_left"),
        7: ("bump_front_center", "bump_right"),
    }
    hazards = [bumper(time, *pressed.get(row, ())) for row, time in enumerate(TIMES)]
    found = [
        sample.reading.view.ravel().tolist() for sample in opened(write(WHEELS, hazards), touch="/hazards")
    ]
    assert {row: view for row, view in enumerate(found) if any(view)} == {
        3: [1.0, 0.0, 0.0, 0.0, 0.0], 5: [0.0, 0.0, 0.0, 0.0, 1.0], 7: [0.0, 0.0, 1.0, 0.0, 1.0],
    }  # fmt: skip
    cliffs = {"topic": "/hazards", "joints": ["cliff_side_left"]}
    assert [sample.reading.view.sum() for sample in opened(write(WHEELS, hazards), touch=cliffs)] == [
        float(row == 5) for row in range(12)
    ]
    readings = [
        {"header": header(0, f"ir_intensity_{side}"), "value": value}
        for side, value in (("left", 400), ("right", 100))
    ]
    infrared = "irobot_create_msgs/msg/IrIntensityVector"
    ir = [Entry("/ir", infrared, time, {"header": header(time), "readings": readings}) for time in TIMES]
    view = next(iter(opened(write(WHEELS, ir), touch={"topic": "/ir", "high": 1000.0}))).reading.view
    assert view.ravel().tolist() == [0.4, 0.1]
    parts = [
        Entry(
            "/bumper", "create_msgs/msg/Bumper", time, {"header": header(time), "is_right_pressed": row == 4}
        )
        for row, time in enumerate(TIMES)
    ]
    found = [sample.reading.view.ravel().tolist() for sample in opened(write(WHEELS, parts), touch="/bumper")]
    assert [row for row, view in enumerate(found) if view == [0.0, 1.0]] == [4]
    with pytest.raises(InputError, match=r"no sensor .is_pressed. .*; expected one of is_left_pressed"):
        opened(write(WHEELS, parts), touch={"topic": "/bumper", "joints": ["is_pressed"]})
    (topic,) = (each for each in describe_bag(write(WHEELS, hazards)).topics if each.name == "/hazards")
    assert topic.roles == ("touch",)
    assert topic.shape.size == (5,)


def test_a_mount_that_is_repeated_on_tf_is_its_first_transform(write):
    rings = [scan(time, 1 + np.arange(72) % 7, -np.pi, np.pi / 36) for time in TIMES]
    once = opened(write(WHEELS, rings, [link("base_link", "laser", 1.0)]), views="/scan")
    repeated = framed("base_link", "laser", np.tile([0.0, 0.0, 1.0], (len(TIMES), 1)))
    again = opened(write(WHEELS, rings, repeated), views="/scan")
    views = [[sample.reading.view.tobytes() for sample in each] for each in (once, again)]
    assert views[0] == views[1]
