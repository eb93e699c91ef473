"""The page of ``r3dpa data view``: what it holds, and its script run in node."""

import base64
import html
import json
import re
import shutil
import subprocess
import zlib
from importlib.resources import files

import numpy as np
import pytest

from r3dpa.geometry import LidarSensor
from r3dpa.viz import Category, PageScan, scan_page
from r3dpa.viz.page import PAGE_RANGE_MAP, STEP_M, pack_scan
from r3dpa.viz.pictures import PALETTE, paint, range_scale

SEMANTICS = {7: Category("road", "#102030"), 26: Category("car")}
ORIGINS = {0: Category("surface", "#56606e"), 6: Category("rain", "#4e9bff")}
TYPES = {
    **dict.fromkeys(("x", "y", "z"), "<i2"),
    **dict.fromkeys(("semantic", "instance"), "<u2"),
    **dict.fromkeys(("intensity", "origin"), "u1"),
}
EVIL = "</script><script>alert(1)</script><!-- \" & '{{points}}"

needs_node = pytest.mark.skipif(shutil.which("node") is None, reason="node is not installed")


def example(name="drive/0000000000", num_points=500, reach_m=80.0):
    generator = np.random.default_rng(0)
    points = generator.uniform(-reach_m, reach_m, (num_points, 4)).astype(np.float32)
    points[:, 3] = generator.uniform(0, 1, num_points)
    labels = generator.choice([7, 26, 26 | 5 << 16, 33 | 65535 << 16], num_points)
    return PageScan(name, points, labels.astype("<u4"), generator.choice([0, 6], num_points))


def page_data(page):
    return json.loads(re.search(r'id="page">(.*?)</script>', page, re.DOTALL)[1])


def unpacked(page, number):
    """Columns of a scan of a page, decoded by the description in ``pack_scan``."""
    header = page_data(page)["scans"][number]
    text = re.search(rf'id="points-{number}">([\w+/=]*)</script>', page)[1]
    data = zlib.decompress(base64.b64decode(text))
    columns = {}
    for name in header["columns"]:
        size = header["count"] * np.dtype(TYPES[name]).itemsize
        columns[name] = np.frombuffer(data[:size], TYPES[name])
        data = data[size:]
    assert data == b""
    for axis in "xyz":
        columns[axis] = np.cumsum(columns[axis], dtype=np.int16) * header["step_m"]
    columns["intensity"] = columns["intensity"] / 255 * header["intensity_max"]
    return header, columns


class TestData:
    def test_points_are_kept_to_half_a_step_and_labels_exactly(self):
        scan = example()
        header, columns = unpacked(scan_page([scan], "a title", SEMANTICS, ORIGINS), 0)
        assert header["name"] == scan.name
        assert header["step_m"] == STEP_M
        xyz = np.stack([columns[axis] for axis in "xyz"], axis=1)
        # Neighbours are up to 160 m apart, 32000 steps: the largest differences nearly fill int16.
        assert np.abs(xyz - scan.points[:, :3]).max() <= STEP_M / 2 + 1e-6
        assert np.abs(columns["intensity"] - scan.points[:, 3]).max() <= 0.5 / 255 + 1e-6
        assert (columns["semantic"] == scan.labels & 0xFFFF).all()
        assert (columns["instance"] == scan.labels >> 16).all()
        assert (columns["origin"] == scan.origins).all()

    def test_labels_may_be_bytes(self):
        labels = np.array([7, 26, 26], np.uint8)
        page = scan_page([PageScan("a", np.ones((3, 4)), labels)], "", SEMANTICS, {})
        assert [row[0] for row in page_data(page)["categories"]["semantic"]] == [7, 26]
        assert unpacked(page, 0)[1]["semantic"].tolist() == [7, 26, 26]

    def test_differences_that_wrap_around_and_a_longer_reach_come_back(self):
        points = np.array([[163, 0, 0, 0], [-163, 0, 0, 0], [163, 1, 2, 9]], np.float32)
        _, columns = unpacked(scan_page([PageScan("a", points)], "", {}, {}), 0)
        assert columns["x"] == pytest.approx([163, -163, 163], abs=STEP_M / 2 + 1e-6)
        assert columns["intensity"] == pytest.approx([0, 0, 9])
        header, columns = unpacked(scan_page([PageScan("a", 10 * points)], "", {}, {}), 0)
        assert header["step_m"] == pytest.approx(1630 / 32767)
        assert columns["x"] == pytest.approx([1630, -1630, 1630], abs=header["step_m"] / 2)

    def test_categories_are_those_that_occur_with_a_name_and_colour_each(self):
        page = page_data(scan_page([example()], "", SEMANTICS, ORIGINS | {9: Category("sun")}))
        assert page["categories"]["semantic"] == [
            [7, "road", "#102030"],
            [26, "car", PALETTE[0]],
            [33, "number 33", PALETTE[1]],
        ]
        assert page["categories"]["origin"] == [[0, "surface", "#56606e"], [6, "rain", "#4e9bff"]]

    def test_scans_beside_come_last_and_their_categories_count(self):
        scans = [PageScan("a", np.ones((2, 3))), PageScan("b", np.ones((2, 3)))]
        page = page_data(scan_page(scans, "", SEMANTICS, ORIGINS, beside=[example("real")]))
        assert [header["name"] for header in page["scans"]] == ["a", "b", "real"]
        assert (page["shown"], page["beside"]) == (2, [2, 2])
        assert len(page["categories"]["semantic"]) == 3
        page = page_data(scan_page(scans, "", {}, {}, beside=scans))
        assert (page["shown"], page["beside"]) == (2, [2, 3])
        assert page_data(scan_page(scans, "", {}, {}))["beside"] == []
        with pytest.raises(ValueError, match="2 scans need 1 or 2 scans beside them, got 3"):
            scan_page(scans, "", {}, {}, beside=[*scans, *scans[:1]])


class TestSafety:
    def test_page_loads_nothing_from_anywhere(self):
        page = scan_page([example()], "title", SEMANTICS, ORIGINS)
        assert "://" not in page
        assert not re.search(r"<link|<img|<iframe|@import|url\(|\bsrc=|\bfetch\(|import\(", page)
        assert "default-src 'none'" in page
        assert "{{" not in page

    def test_names_cannot_end_the_script_or_become_markup(self):
        scan = example(name=EVIL)
        semantics = {7: Category(EVIL), 26: Category("car")}
        page = scan_page([scan], EVIL, semantics, ORIGINS, beside=[example(name=EVIL)])
        harmless = scan_page([scan], "t", SEMANTICS, ORIGINS, beside=[example(name="b")])
        for markup in ("<script", "</script", "<!--"):
            assert page.count(markup) == harmless.count(markup)
        assert f"<title>{html.escape(EVIL)}</title>" in page
        assert [header["name"] for header in page_data(page)["scans"]] == [EVIL, EVIL]
        assert page_data(page)["categories"]["semantic"][0][1] == EVIL


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"points": np.ones((3, 2))}, r"s: points must be \(P, 3\) or \(P, 4\), got \(3, 2\)"),
        ({"points": np.full((3, 3), np.nan)}, "s: has NaN or infinite values"),
        ({"labels": np.zeros(2, int)}, r"s: labels must be \(3,\), got \(2,\)"),
    ],
)
def test_errors_say_which_scan_and_what_is_wrong(change, message):
    with pytest.raises(ValueError, match=message):
        scan_page([PageScan(**({"name": "s", "points": np.ones((3, 4))} | change))], "", {}, {})


def run_node(body, **given):
    """What ``body`` returns as JSON; it sees ``Cloud`` and the given values."""
    cloud = (files("r3dpa.viz") / "page_cloud.js").read_text("utf-8")
    code = f"{cloud}\n(async (given) => {{ {body} }})({json.dumps(given)})"
    code += ".then((result) => console.log(JSON.stringify(result)));"
    command = subprocess.run(
        ["node", "-"], input=code, capture_output=True, text=True, check=False, timeout=60
    )
    assert command.returncode == 0, command.stderr
    return json.loads(command.stdout)


def camera(**change):
    usual = {"target": [2.0, 1.0, -1.0], "distance": 30.0, "yaw": 0.7, "pitch": 0.4, "flat": False}
    return usual | change


def projected(points, view, width, height):
    """Column, row and depth of points by a homogeneous camera matrix, as in textbooks."""
    yaw, pitch = view["yaw"], view["pitch"]
    forward = [np.cos(pitch) * np.cos(yaw), np.cos(pitch) * np.sin(yaw), -np.sin(pitch)]
    right = [np.sin(yaw), -np.cos(yaw), 0]
    rotation = np.stack([right, np.cross(forward, right), forward])
    seen = (points - view["target"]) @ rotation.T + [0, 0, view["distance"]]
    focal = np.sqrt(width * height) / 2 / np.tan(np.radians(25))
    matrix = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    depth = np.full(len(seen), view["distance"]) if view["flat"] else seen[:, 2]
    pixel = (seen[:, :2] / depth[:, None]) @ matrix[:2, :2] + matrix[:2, 2]
    return pixel, seen[:, 2]


@needs_node
class TestScript:
    def test_the_viewer_is_a_valid_script(self):
        path = files("r3dpa.viz") / "page_viewer.js"
        subprocess.run(["node", "--check", str(path)], check=True, timeout=60)

    def test_unpacks_what_python_packed(self):
        scan = example(num_points=50)
        header, text = pack_scan(scan)
        cloud = run_node(
            "const cloud = await Cloud.unpack(given.header, given.text);"
            "for (const name in cloud) if (name !== 'count') cloud[name] = [...cloud[name]];"
            "return cloud;",
            header=header,
            text=text,
        )
        xyz = np.reshape(cloud["xyz"], (-1, 3))
        assert np.abs(xyz - scan.points[:, :3]).max() <= STEP_M / 2 + 1e-5
        ranges = np.linalg.norm(scan.points[:, :3], axis=1)
        assert cloud["range"] == pytest.approx(ranges, abs=STEP_M)
        assert cloud["intensity"] == pytest.approx(scan.points[:, 3], abs=0.51 / 255)
        assert cloud["semantic"] == (scan.labels & 0xFFFF).tolist()
        assert cloud["instance"] == (scan.labels >> 16).tolist()
        assert cloud["origin"] == scan.origins.tolist()

    @pytest.mark.parametrize("flat", [False, True])
    def test_projection_is_that_of_a_camera_matrix(self, flat):
        points = np.random.default_rng(1).uniform(-10, 10, (40, 3))
        view, size = camera(flat=flat), (320, 180)
        found = run_node(
            "const p = Cloud.projectionOf(given.view, ...given.size);"
            "return given.points.map((point) => Cloud.project(p, ...point));",
            view=view,
            size=size,
            points=points.tolist(),
        )
        pixel, depth = projected(points, view, *size)
        assert np.array(found)[:, :2] == pytest.approx(pixel, abs=1e-6)
        assert np.array(found)[:, 2] == pytest.approx(depth, abs=1e-9)

    def test_drawn_pixels_are_those_of_numpy_and_the_nearest_point_shows(self):
        points = np.random.default_rng(2).uniform(-12, 12, (4000, 3)).astype(np.float32)
        view, (width, height) = camera(), (96, 54)
        drawn = run_node(
            "const xyz = Float32Array.from(given.points.flat());"
            "const cloud = { count: given.points.length, xyz };"
            "const colours = new Uint32Array(cloud.count).map((_, i) => (i % 7 ? i : 0));"
            "const frame = Cloud.newFrame(...given.size);"
            "const p = Cloud.projectionOf(given.view, ...given.size);"
            "Cloud.drawPoints(frame, p, cloud, colours, 1, null);"
            "return { index: [...frame.index], colour: [...frame.colour] };",
            points=points.tolist(),
            view=view,
            size=(width, height),
        )
        # So far away that every point is one pixel at size 1: 0.05 m * focal / depth < 1.5.
        pixel, depth = projected(points, view, width, height)
        column, row = np.floor(pixel).astype(int).T
        inside = (column >= 0) & (column < width) & (row >= 0) & (row < height) & (depth > 0.3)
        shown = np.flatnonzero(inside & (np.arange(len(points)) % 7 != 0))
        expected = np.full((height, width), -1)
        for point in shown[np.argsort(-depth[shown], kind="stable")]:
            expected[row[point], column[point]] = point
        # Projected in another order of operations, a point on the edge of a pixel may fall beside.
        found = np.reshape(drawn["index"], (height, width))
        assert (found != expected).mean() < 1e-3
        assert (found >= 0).sum() > 500
        assert drawn["colour"] == np.where(found < 0, 0, found).ravel().tolist()

    def test_a_point_behind_the_camera_is_not_drawn_and_large_ones_are_clipped(self):
        counts = run_node(
            "const view = { target: [0, 0, 0], distance: 1, yaw: 0, pitch: 0, flat: false };"
            "const frame = Cloud.newFrame(40, 40), p = Cloud.projectionOf(view, 40, 40);"
            "return given.points.map((point) => {"
            "  const cloud = { count: 1, xyz: Float32Array.from(point) };"
            "  Cloud.drawPoints(frame, p, cloud, new Uint32Array([1]), 4, null);"
            "  return frame.index.filter((i) => i === 0).length;"
            "});",
            points=[[-5, 0, 0], [0, 0, 0], [0, 0.46, 0.46]],
        )
        behind, ahead, corner = counts
        assert behind == 0
        assert ahead == 9 * 9 - 4  # 0.05 m * 4 * 42.9 px/m = 8.6, less the corners
        assert 0 < corner < ahead

    def test_picks_the_nearest_drawn_point_within_the_radius(self):
        found = run_node(
            "const frame = Cloud.newFrame(20, 10);"
            "frame.index[3 * 20 + 5] = 7; frame.index[3 * 20 + 9] = 8; frame.index[0] = 9;"
            "return given.at.map(([column, row]) => Cloud.pick(frame, column, row, 3));",
            at=[[5.5, 3.2], [8.1, 3.0], [6.5, 3.5], [5, 6], [5, 7], [19, 9], [-1, -1]],
        )
        assert found == [7, 8, 7, 7, -1, -1, 9]

    def test_colours_are_those_of_matplotlib_and_hidden_categories_vanish(self):
        scan = example(num_points=300)
        page = page_data(scan_page([scan], "", SEMANTICS, ORIGINS))
        header, text = pack_scan(scan)
        drawn = run_node(
            "const cloud = await Cloud.unpack(given.header, given.text);"
            "const rgb = Cloud.bytesOf(given.scale.rgb);"
            "const colours = Uint32Array.from({ length: 256 }, (_, i) =>"
            "  Cloud.pack(rgb[3 * i], rgb[3 * i + 1], rgb[3 * i + 2]));"
            "const table = new Map(given.rows.map(([id, , hex]) => [id, Cloud.packHex(hex)]));"
            "const colour = (mode, table, hidden) =>"
            "  [...Cloud.colourise(cloud, mode, table, new Set(hidden))];"
            "delete cloud.origin;"
            "return {"
            "  range: colour('range', { ...given.scale, colours }, []),"
            "  exact: [...cloud.range],"
            "  semantic: colour('semantic', table, [26]),"
            "  instance: colour('instance', null, []),"
            "  origin: colour('origin', table, []),"
            "  counts: [...Cloud.countValues(cloud.semantic)],"
            "};",
            header=header,
            text=text,
            scale=page["scales"]["range"],
            rows=page["categories"]["semantic"],
        )

        def packed(rgb):
            return (0xFF000000 | rgb[..., 2] << 16 | rgb[..., 1] << 8 | rgb[..., 0]).tolist()

        sensor = LidarSensor()
        painted = paint(np.array(drawn["exact"]), PAGE_RANGE_MAP, range_scale(sensor))
        assert drawn["range"] == packed(painted.astype(np.int64))
        colours = {7: 0xFF302010, 26: 0, 33: packed(np.array([0xFF, 0xB0, 0x00]))}
        semantic = (scan.labels & 0xFFFF).tolist()
        assert drawn["semantic"] == [colours[number] for number in semantic]
        instances = (scan.labels >> 16).tolist()
        by_instance = dict(zip(instances, drawn["instance"], strict=True))
        assert len(set(by_instance.values())) == len(by_instance) == 3
        assert drawn["instance"] == [by_instance[number] for number in instances]
        assert len(set(drawn["origin"])) == 1  # not known: all grey
        assert dict(drawn["counts"]) == {number: semantic.count(number) for number in (7, 26, 33)}
