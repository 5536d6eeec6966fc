"""Scans and clouds become sectors about the robot, and images of every encoding the same grey image."""

import io

import numpy as np
import pytest
from PIL import Image

from robot.recordings.bags import views
from robot.recordings.bags.bag_description import describe_bag
from robot.recordings.bags.transforms import Mount
from robot.recordings.bags.views import COMPRESSED, RAW, Extent, cloud_view, scan_view
from tests.helpers.ros_bags import ROS2, Entry, built, header, image, odometry, scan
from tests.robot.recordings.bags.conftest import opened

AHEAD = Mount(np.eye(3), np.zeros(3))
ROLLED = Mount(np.diag([1.0, -1.0, -1.0]), np.zeros(3))  # upside down


def turned(yaw):
    c, s = np.cos(yaw), np.sin(yaw)
    return Mount(np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]), np.zeros(3))


def message(ranges, first, step, **fields):
    return built(ROS2, "sensor_msgs/msg/LaserScan", scan(0, ranges, first, step, **fields).fields)


def sectors(content, pixels, mount=AHEAD, max_range=4.0):
    view = scan_view(content, mount, pixels, max_range, "here")
    return None if view is None else view.pixels.tolist()


def test_a_fan_keeps_groups_of_consecutive_beams():
    assert sectors(message([1, 3, 2, 2, 8, 0], -0.5, 0.2), 3) == [0.5, 0.5, 0.5]
    assert sectors(message([1, 1, 1, 2, 2], -0.5, 0.2), 2) == [0.25, 0.5]  # 3 and 2 beams
    for first, step, mount in ((-0.2, 0.2, AHEAD), (0.2, -0.2, AHEAD), (-0.2, 0.2, ROLLED)):
        assert sectors(message([1, 2, 3], first, step), 3, mount) == [0.25, 0.5, 0.75]


def test_a_ring_runs_counter_clockwise():
    step = 2 * np.pi / 8
    assert sectors(message([1, 2, 2, 3, 3, 4, 4, 1], step / 2, -step), 4) == [0.75, 0.5, 0.25, 1.0]
    ranges = np.full(360, 4.0)
    ranges[1:90] = 1.0  # to the left of its axis, hence to the right of the robot
    found = sectors(message(ranges, 0.0, np.pi / 180), 4, ROLLED)
    assert found == pytest.approx([1, 0.25, 1, 1], abs=0.02)


@pytest.mark.parametrize("first", [0.0, -np.pi])
@pytest.mark.parametrize("yaw", [0.0, 0.5 * np.pi, np.pi])
def test_a_ring_begins_behind_the_robot(first, yaw):
    step = 2 * np.pi / 360
    angles = first + step * np.arange(360) + yaw  # in the frame of the robot
    direction = (angles + np.pi) % (2 * np.pi)
    ranges = np.where(direction < np.deg2rad(45), 1.0, 4.0)
    ranges[(direction > np.deg2rad(181)) & (direction < np.deg2rad(224))] = 2.0
    found = sectors(message(ranges, first, step), 8, turned(yaw))
    assert found == pytest.approx([0.25, 1, 1, 1, 0.5, 1, 1, 1], abs=0.05)


SHARED = Extent(0.0, 1.8, 0.1)  # 18 beams over 1.8 rad: six sectors of three
VARIED = {
    "as shared": ([1] * 9 + [2] * 9, -0.85, 0.1, [1, 1, 1, 2, 2, 2]),
    "clockwise": ([1] * 9 + [2] * 9, 0.85, -0.1, [2, 2, 2, 1, 1, 1]),
    "a turn on": ([1] * 9 + [2] * 9, -0.85 + 2 * np.pi, 0.1, [1, 1, 1, 2, 2, 2]),
    "twice as many": ([1] * 18 + [2] * 18, -0.875, 0.05, [1, 1, 1, 2, 2, 2]),
    "a third as many": ([1, 1, 1, 2, 2, 2], -0.75, 0.3, [1, 1, 1, 2, 2, 2]),
    "without its ends": ([1] * 6 + [2] * 6, -0.55, 0.1, [1, 1, 1, 2, 2, 2]),
    "shifted": ([1] * 6 + [2] * 12, -0.55, 0.1, [1, 1, 1, 2, 2, 2]),
    "too narrow": ([2] * 3, 0.05, 0.1, [2] * 6),
    "a whole turn": ([1] * 32 + [2] * 31, -np.pi, 0.1, [1, 1, 1, 2, 2, 2]),
}


@pytest.mark.parametrize("case", VARIED)
def test_beams_go_to_sectors_by_direction(case):
    ranges, first, step, expected = VARIED[case]
    view = scan_view(message(ranges, first, step), AHEAD, 6, 4.0, "here", SHARED)
    assert view.pixels == pytest.approx(np.array(expected) / 4, abs=0.01)
    covered = {"without its ends": 4 / 6, "shifted": 5 / 6, "too narrow": 1 / 6}.get(case, 1)
    assert view.covered == pytest.approx(covered)


def test_a_part_of_a_ring_has_the_sectors_of_the_ring():
    step = 2 * np.pi / 36
    whole = np.repeat([1.0, 2.0, 3.0, 2.0], 9)
    shared = Extent(0.0, 2 * np.pi, step)
    part = message(whole[9:], -np.pi / 2 + step / 2, step)
    view = scan_view(part, AHEAD, 4, 4.0, "here", shared)
    assert (view.pixels.tolist(), view.covered) == ([0.5, 0.5, 0.75, 0.5], 0.75)
    rear = scan_view(part, turned(np.pi), 4, 4.0, "here", shared)
    assert rear.pixels.tolist() == [0.75, 0.5, 0.5, 0.5]


def test_the_span_of_scans_is_what_they_cover_together():
    first = Extent(0.0, -1.0, 0.01)
    assert views.wider_extent([first, Extent(2 * np.pi + 0.001, 1.0, 0.01)]) is None
    wider = views.wider_extent([first, Extent(0.2, 1.0, 0.01), Extent(-0.1, 0.2, 0.01)])
    assert wider.span == pytest.approx((0.7, -0.5))
    ring = views.wider_extent([Extent(0.0, 4.0, 0.01), Extent(np.pi, 4.0, 0.01)])
    assert ring.span == (-np.pi, np.pi)
    assert views.wider_extent([first, first, Extent(3.0, 1.0, 0.01)]) is None  # most cover a part of it


def test_beams_without_a_measurement_do_not_count():
    """NaN, -inf and below range_min; +inf and beyond range_max mean that nothing is there."""
    fan = message([np.nan, 1, -np.inf, 2, 0.05, 3, np.inf, 2, 90, 2], -0.5, 0.1, range_min=0.1)
    assert sectors(fan, 5) == pytest.approx([0.25, 0.5, 0.75, 0.75, 0.75])
    assert sectors(message([0, 1, 0, 3], -0.5, 0.1), 2) == [0.125, 0.375]  # 0 is a range if range_min is 0
    assert sectors(message([0, 0, 1, 3], -0.5, 0.1, range_min=0.1), 2) == [1.0, 0.5]  # a sector without any
    assert sectors(message([0, 0, np.nan, 0], -0.5, 0.1, range_min=0.1), 2) is None
    assert sectors(message([np.inf] * 4, -0.5, 0.1), 2) == [1.0, 1.0]
    assert sectors(message([1, 3], -0.5, 0.1, range_max=0.0), 2) == [0.25, 0.75]  # no limit can be meant
    step = 2 * np.pi / 8
    ring = message([np.nan, 1, 0.05, 2, np.inf, 4, 90, 4], -np.pi + step / 2, step, range_min=0.1)
    assert sectors(ring, 4) == pytest.approx([0.25, 0.5, 1.0, 1.0])


FIELDS = [{"name": name, "offset": 4 * k, "datatype": 7, "count": 1} for k, name in enumerate("xyz")]


def cloud(points, order="<", **fields):
    """A cloud of float32 x, y, z with a gap of four bytes, as lidar drivers write it."""
    rows = np.pad(points, ((0, 0), (0, 1))).astype(f"{order}f4")
    size = {"height": 1, "width": len(points), "point_step": 16, "row_step": 16 * len(points)}
    data = {"fields": FIELDS, "is_bigendian": order == ">", "data": np.frombuffer(rows.tobytes(), np.uint8)}
    return built(ROS2, "sensor_msgs/msg/PointCloud2", size | data | fields)


POINTS = np.array([[-1, -0.01, 0.5], [-3, -0.02, 0.5], [2, 0.5, 0.5], [0.1, 0.1, -0.2], [np.nan, 0, 0.5]])


@pytest.mark.parametrize("order", ["<", ">"])
def test_a_cloud_is_the_nearest_point_of_each_degree(order):
    view = cloud_view(cloud(POINTS, order), AHEAD, (0.1, 1.0), 360, 4.0, "here")
    near = {0: 1.0 / 4, 180 + int(np.rad2deg(np.arctan2(0.5, 2))): np.hypot(2, 0.5) / 4}
    assert {int(i): view.pixels[i] for i in np.flatnonzero(view.pixels < 1)} == pytest.approx(near, rel=1e-4)
    # Mounted 0.3 m high, to the left: its x axis is the robot's y axis.
    mount = turned(np.pi / 2)._replace(position=np.array([0, 0, 0.3]))
    points = np.array([[1, 0, 0], [2, 0, -0.25]])
    view = cloud_view(cloud(points, order), mount, (0.1, 1.0), 4, 4.0, "here")
    assert np.flatnonzero(view.pixels < 1).tolist() == [3]
    assert view.lowest == pytest.approx(1.0)


def test_damaged_scans_and_clouds_are_refused(refused):
    def read(content):
        return cloud_view(content, AHEAD, (0.1, 1.0), 4, 4.0, "here")

    refused(lambda: sectors(message([1, 3], np.nan, 0.1), 2), "here", "angle_min is nan", "angles in rad")
    refused(lambda: sectors(message([1, 3], 0.0, 0.0), 2), "angle_increment 0.0")
    refused(lambda: sectors(message([1, 3], 0.0, 0.1), 3), "2 beams", "each of 3 sectors")
    refused(lambda: read(cloud(POINTS, fields=[])), "here", "a cloud of no fields", "fields x, y and z")
    refused(lambda: read(cloud(POINTS, width=50)), "1 x 50 points", "data that fit")
    odd = [field | {"datatype": 99} for field in FIELDS]
    refused(lambda: read(cloud(POINTS, fields=odd)), "data that fit")
    assert read(cloud(np.full((3, 3), np.nan))) is None


COLOUR = np.random.default_rng(0).integers(0, 256, (5, 7, 3), dtype=np.uint8)
GREY = np.asarray(Image.fromarray(COLOUR).convert("L"))


def raw(pixels, encoding, padding=0, **fields):
    rows = np.frombuffer(np.ascontiguousarray(pixels).tobytes(), np.uint8).reshape(len(pixels), -1)
    data = np.pad(rows, ((0, 0), (0, padding)), constant_values=7)
    given = {"step": data.shape[1], "data": data.reshape(-1)} | fields
    return built(ROS2, RAW, image(0, pixels, encoding, **given).fields)


def with_alpha(pixels):
    return np.concatenate([pixels, np.full((*pixels.shape[:2], 1), 9, np.uint8)], axis=2)


def encoded(pixels, kind="PNG", **options):
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, kind, **options)
    return np.frombuffer(file.getvalue(), np.uint8)


def compressed(pixels, kind, **options):
    return built(ROS2, COMPRESSED, {"format": kind.lower(), "data": encoded(pixels, kind, **options)})


def grey_of(content):
    return views.grey_image(content, COMPRESSED if hasattr(content, "format") else RAW, "here")


DEEP = GREY.astype(int) * 256 + 77
OTHER = np.full_like(GREY, 128)
PLANES = np.concatenate([GREY.ravel(), OTHER.ravel()[:21]])
BEFORE, BEHIND = np.stack([OTHER, GREY], -1), np.stack([GREY, OTHER], -1)
UNCOMPRESSED = {
    "mono8": GREY, "8UC1": GREY, "mono16": DEEP.astype("<u2"), "rgb8": COLOUR, "bgr8": COLOUR[..., ::-1],
    "rgba8": with_alpha(COLOUR), "bgra8": with_alpha(COLOUR[..., ::-1]),
    "yuv422": BEFORE, "uyvy": BEFORE, "yuv422_yuy2": BEHIND, "yuyv": BEHIND,
}  # fmt: skip
COLOURED = ("rgb8", "bgr8", "rgba8", "bgra8")
READABLE = {name: (raw(pixels, name, 2), name in COLOURED) for name, pixels in UNCOMPRESSED.items()} | {
    "big-endian mono16": (raw(DEEP.astype(">u2"), "mono16", 2, is_bigendian=1), 0),
    "nv12": (raw(GREY, "nv12", data=PLANES), 0),
    "nv21": (raw(GREY, "nv21", data=PLANES), 0),
    "PNG of 16 bits": (compressed(DEEP.astype("<u2"), "PNG"), 0),
}
for kind, away, options in (("PNG", 0, {}), ("WebP", 1, {"lossless": True}),
                            ("JPEG", 4, {"quality": 100, "subsampling": 0})):  # fmt: skip
    READABLE[f"grey {kind}"] = compressed(GREY, kind, **options), away
    READABLE[kind] = compressed(COLOUR, kind, **options), away
"""Images, and how far their grey levels may be from those of Pillow."""


@pytest.mark.parametrize(("content", "away"), READABLE.values(), ids=READABLE.keys())
def test_images_become_grey(content, away):
    grey = grey_of(content)
    assert grey.dtype == np.uint8
    assert np.abs(grey.astype(int) - GREY).max() <= away


@pytest.mark.parametrize("order", ["rggb", "bggr", "gbrg", "grbg"])
def test_a_mosaic_is_the_mean_of_its_colours(order):
    block = np.array([{"r": 40, "g": 80, "b": 200}[name] for name in order]).reshape(2, 2)
    for bits in (8, 16):
        pixels = np.tile(block << bits - 8, (3, 4))[:5, :7].astype(f"u{bits // 8}")
        grey = grey_of(raw(pixels, f"bayer_{order}{bits}", 2))
        assert (grey.shape, np.unique(grey).tolist()) == ((5, 7), [100])


def test_images_that_cannot_be_read_are_refused(refused):
    nonsense = {"format": "jpeg", "data": np.arange(99, dtype=np.uint8)}
    cut = {"format": "png", "data": encoded(COLOUR)[:60]}
    for content, *pieces in (
        (raw(GREY, "lab8"), "here", "encoding 'lab8'", "mono8"),
        (raw(GREY.astype("f4"), "32FC1"), "distances (32FC1", "recording.topics.views"),
        (raw(GREY, "mono8", height=6), "7 x 6 pixels", "in 35 bytes"),
        (raw(GREY, "rgb8"), "7 bytes a row"),
        (raw(GREY, "mono8", width=0), "0 x 5 pixels"),
        (built(ROS2, COMPRESSED, {"format": "32FC1; compressedDepth png"}), "distances (32FC1"),
        (built(ROS2, COMPRESSED, nonsense), "99 bytes of format 'jpeg'"),
        (built(ROS2, COMPRESSED, cut), "cannot be decoded"),
    ):
        refused(lambda content=content: grey_of(content), *pieces)


SPOILT = [np.arange(99, dtype=np.uint8), np.zeros(0, np.uint8), encoded(COLOUR[:4])]


@pytest.mark.parametrize("data", SPOILT, ids=["broken", "empty", "of another size"])
def test_one_image_that_cannot_be_used_is_left_out(data, write):
    times, told, entries = range(10**9, 3 * 10**9, 10**8), [], []
    for row, time in enumerate(times):
        fields = {"header": header(time), "format": "png", "data": encoded(COLOUR)}
        entries.append(Entry("/camera", COMPRESSED, time, fields | ({"data": data} if row == 5 else {})))
    path = write([odometry(time, time / 10**10, 0, 0) for time in times], entries)
    source = opened(path, told, views="/camera", image={"rows": 4, "columns": 7})
    assert (source.seen.tolist(), len(told)) == ([row != 5 for row in range(20)], 1)
    assert "message 5, at 1.500 s: " in told[0]
    assert "1 of 20 messages are left out" in told[0]
    assert describe_bag(path).topics[0].roles == ("views",)
