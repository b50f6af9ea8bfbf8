"""Maps in the formats of other programs, each read back by a reader that is not ours."""

import base64
import json
import math
import shutil
import subprocess
import xml.etree.ElementTree as ET
from collections.abc import Callable
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from io import BytesIO
from pathlib import Path
from queue import Queue
from threading import Thread
from typing import Any, get_args

import ezdxf
import numpy as np
import pytest
import shapely
from maps import random_map
from PIL import Image
from rosbags.highlevel import AnyReader
from rosbags.interfaces import QosDurability
from ruamel.yaml import YAML

from linemap_jax.cli.export import FormatName
from linemap_jax.core.state import LineMap
from linemap_jax.io.atomic import OutputError
from linemap_jax.io.exports import FORMATS, Content, format_of
from linemap_jax.io.html import MOST_NUMBERS, MOST_POINTS, Moment, figure_of_moments, write_html
from linemap_jax.io.map_file import MapFileError
from linemap_jax.io.nav2 import write_nav2
from linemap_jax.io.shapes import line_bands, used
from linemap_jax.io.thinned import Thinned

STAMPS = 1.7e9 + np.arange(40) * 0.1
POSES = np.stack([np.linspace(-20, 20, 40), np.sin(np.arange(40) / 5), np.linspace(-3, 3, 40)], -1)


@pytest.fixture(scope="module")
def line_map() -> LineMap:
    return random_map("float32")


@pytest.fixture(scope="module")
def content(line_map: LineMap) -> Content:
    return Content(
        line_map=line_map,
        settings={"preset": "default"},
        title="a <map> & more",
        timestamps=STAMPS,
        poses=POSES,
        points=POSES[:, :2] + 1,
        grid=(np.array([[0, 100, -1], [0, 0, 0]], np.int8), np.array([-1.5, 2.0]), 0.05),
    )


@pytest.fixture
def written(content: Content, tmp_path: Path) -> Callable[[str], Path]:
    """Writes the map in a format, and gives the file."""

    def write(name: str) -> Path:
        path = tmp_path / f"map{FORMATS[name].ending}"
        FORMATS[name].write(path, content, False)
        return path

    return write


def ends_of(line_map: LineMap) -> np.ndarray:
    valid = np.asarray(line_map.lines.valid)
    return np.stack([np.asarray(line_map.lines.begin)[valid], np.asarray(line_map.lines.end)[valid]], 1)


def test_the_table_of_formats() -> None:
    assert tuple(FORMATS) == get_args(FormatName)
    assert all(format_of(f"some/Map{format.ending.upper()}") == name for name, format in FORMATS.items())
    assert format_of("map.doc") is None


@pytest.mark.parametrize("name", FORMATS)
def test_an_older_file_is_left_alone_unless_told_otherwise(content: Content, tmp_path: Path, name: str) -> None:
    path = tmp_path / f"map{FORMATS[name].ending}"
    path.write_text("old")
    with pytest.raises((OutputError, MapFileError), match="exists already; use --overwrite"):
        FORMATS[name].write(path, content, False)
    assert [file.name for file in tmp_path.iterdir()] == [path.name]
    assert path.read_text() == "old"
    FORMATS[name].write(path, content, True)
    assert path.read_bytes() != b"old"
    assert not [file for file in tmp_path.iterdir() if file.name.startswith(".")]


def test_svg(written: Callable[[str], Path], line_map: LineMap) -> None:
    svg, label = "{http://www.w3.org/2000/svg}", "{http://www.inkscape.org/namespaces/inkscape}label"
    root = ET.parse(written("svg")).getroot()
    assert root.findtext(f"{svg}title") == "a <map> & more"
    layers = {group.get(label): group for group in root.iter(f"{svg}g") if group.get(label)}
    assert set(layers) == {"bands", "path", "circles", "lines", "ellipses", "scale"}

    found = [[float(line.get(name, "")) for name in ("x1", "y1", "x2", "y2")] for line in layers["lines"]]
    np.testing.assert_allclose(np.reshape(found, (-1, 2, 2)), ends_of(line_map), atol=1e-4)
    circles = used(line_map.circles)
    found = [[float(circle.get(name, "")) for name in ("cx", "cy", "r")] for circle in layers["circles"]]
    np.testing.assert_allclose(found, np.column_stack([circles.center, circles.radius]), atol=1e-4)
    for polygon, ends in zip(layers["bands"], ends_of(line_map), strict=True):
        corners = [tuple(map(float, place.split(","))) for place in polygon.get("points", "").split()]
        # A long band whose angle is uncertain is a bow tie of two hyperbolas; its hull holds the line.
        assert shapely.MultiPoint(corners).convex_hull.buffer(1e-3).covers(shapely.LineString(ends))
    assert len(layers["ellipses"]) == circles.fitted.sum()
    path = [tuple(map(float, place.split(","))) for place in layers["path"][0].get("points", "").split()]
    np.testing.assert_allclose(path, POSES[:, :2], atol=1e-4)

    # To scale: 1 : 100, and all of it within the page; in the page y points downwards.
    left, top, width, height = map(float, root.get("viewBox", "").split())
    on_paper = [float(root.get(side, "").removesuffix("mm")) for side in ("width", "height")]
    np.testing.assert_allclose(on_paper, [10 * width, 10 * height], atol=1e-3)
    page = shapely.box(left, -top - height, left + width, -top)
    assert page.covers(shapely.MultiLineString(list(ends_of(line_map))))
    assert [group.get("transform") for group in root if group.get("transform")] == ["scale(1 -1)"]
    assert float(layers["scale"][0].get("width", "")) == 1.0


def test_dxf(written: Callable[[str], Path], line_map: LineMap) -> None:
    document = ezdxf.readfile(written("dxf"))  # pyright: ignore[reportPrivateImportUsage]
    assert document.units == ezdxf.units.M  # pyright: ignore[reportAttributeAccessIssue]
    assert not document.audit().has_errors
    space = document.modelspace()

    def on(layer: str) -> list[Any]:
        return list(space.query(f'*[layer=="{layer}"]'))

    found = [[line.dxf.start.vec2, line.dxf.end.vec2] for line in on("LINES")]
    np.testing.assert_allclose(np.array(found, float), ends_of(line_map), atol=1e-4)
    circles = used(line_map.circles)
    found = [[*circle.dxf.center.vec2, circle.dxf.radius] for circle in on("CIRCLES")]
    np.testing.assert_allclose(found, np.column_stack([circles.center, circles.radius]), atol=1e-6)
    bands = np.array([list(band.get_points("xy")) for band in on("BANDS")])
    np.testing.assert_allclose(bands, line_bands(used(line_map.lines), 0.95), atol=1e-9)
    for ellipse, cov in zip(on("ELLIPSES"), np.asarray(circles.cov, float)[circles.fitted, :2, :2], strict=True):
        # Each point of the rim has the Mahalanobis distance of 95 %.
        rim = np.array([point.vec2 for point in ellipse.vertices(np.linspace(0, 6, 7))], float)
        step = rim - np.array(ellipse.dxf.center.vec2, float)
        np.testing.assert_allclose(np.einsum("si,ij,sj->s", step, np.linalg.inv(cov), step), 5.991, rtol=1e-3)
    assert len(on("ELLIPSES")) == circles.fitted.sum() > 0
    (path,) = on("PATH")
    np.testing.assert_allclose(list(path.get_points("xy")), POSES[:, :2])


def test_nav2_as_map_server_reads_it(tmp_path: Path) -> None:
    """By the rules of `map_server`: the YAML file, the grey by the thresholds, the first row of the picture on top."""
    rng = np.random.default_rng(0)
    cells = rng.choice(np.array([-1, 0, 100], np.int8), (30, 50))
    write_nav2(tmp_path / "my 'map'.yaml", cells, [-1.5, 2.0], 0.05)
    told = YAML(typ="safe").load((tmp_path / "my 'map'.yaml").read_text())
    assert (told["resolution"], told["origin"], told["negate"], told["mode"]) == (0.05, [-1.5, 2.0, 0.0], 0, "trinary")
    image = Image.open(tmp_path / told["image"])
    assert (image.size, image.mode) == ((50, 30), "L")
    shade = (255 - np.asarray(image, float)) / 255
    read = np.where(shade > told["occupied_thresh"], 100, np.where(shade < told["free_thresh"], 0, -1))
    np.testing.assert_array_equal(read[::-1], cells)
    # nav2's own thresholds have to make the same of what is occupied
    assert ((shade > 0.65) == (read == 100)).all()


def test_mcap_as_rosbags_reads_it(written: Callable[[str], Path], line_map: LineMap) -> None:
    with AnyReader([written("mcap")]) as reader:
        assert {topic: info.msgtype for topic, info in reader.topics.items()} == {
            "/linemap/markers": "visualization_msgs/msg/MarkerArray",
            "/linemap/path": "nav_msgs/msg/Path",
        }
        for connection in reader.connections:
            (qos,) = connection.ext.offered_qos_profiles  # pyright: ignore[reportAttributeAccessIssue]
            assert qos.durability == QosDurability.TRANSIENT_LOCAL
        read: dict[str, Any] = {
            connection.topic: reader.deserialize(data, connection.msgtype) for connection, _, data in reader.messages()
        }
    markers = {marker.ns: marker for marker in read["/linemap/markers"].markers}
    assert set(markers) == {"lines", "bands", "circles", "ellipses"}
    for marker in markers.values():
        assert marker.header.frame_id == "map"
        assert marker.header.stamp.sec == 1_700_000_003
        assert marker.pose.orientation.w == 1
        assert marker.color.a > 0
        assert min(marker.scale.x, 1) > 0

    def points(name: str) -> np.ndarray:
        return np.array([[point.x, point.y] for point in markers[name].points])

    lines, circles = markers["lines"], used(line_map.circles)
    assert lines.type == lines.LINE_LIST
    np.testing.assert_allclose(points("lines").reshape(-1, 2, 2), ends_of(line_map), atol=1e-5)
    rims = points("circles").reshape(len(circles.radius), -1, 2) - circles.center[:, None]
    np.testing.assert_allclose(np.hypot(*rims.T).T, np.broadcast_to(circles.radius[:, None], rims.shape[:2]), atol=1e-4)
    assert markers["bands"].type == lines.TRIANGLE_LIST
    triangles = shapely.polygons(points("bands").reshape(-1, 3, 2))
    strips = shapely.polygons(line_bands(used(line_map.lines), 0.95, 9))
    assert sum(shapely.area(triangles)) == pytest.approx(sum(shapely.area(strips)), rel=1e-6)

    stamped = read["/linemap/path"].poses
    np.testing.assert_allclose([[p.pose.position.x, p.pose.position.y] for p in stamped], POSES[:, :2])
    turn = [2 * math.atan2(p.pose.orientation.z, p.pose.orientation.w) for p in stamped]
    np.testing.assert_allclose(turn, POSES[:, 2], atol=1e-12)
    stamps = [p.header.stamp.sec + p.header.stamp.nanosec * 1e-9 for p in stamped]
    np.testing.assert_allclose(stamps, STAMPS, atol=1e-6)


def test_a_map_without_anything_is_written_too(tmp_path: Path) -> None:
    nothing = Content(line_map=random_map("float32", 0, 0), settings={}, title="")
    for name, format in FORMATS.items():
        if name not in ("nav2", "tum"):
            format.write(tmp_path / f"map{format.ending}", nothing, False)
    assert {file.suffix for file in tmp_path.iterdir()} == {
        format.ending for name, format in FORMATS.items() if name not in ("nav2", "tum")
    }


# --- The page --------------------------------------------------------------------------------------------------------


def moments(count: int) -> list[Moment]:
    """A map that grows: in the n-th moment it has n lines more."""
    return [Moment(random_map("float32", 2 + i, 4), 8 * (i + 1)) for i in range(count)]


def numbers(told: Any) -> np.ndarray:
    """An array as it stands in the page."""
    flat = np.frombuffer(base64.b64decode(told["bdata"]), {"f4": np.float32}[told["dtype"]])
    return flat.reshape([int(n) for n in told["shape"].split(",")]) if "shape" in told else flat


def test_the_page_says_of_each_line_what_it_is() -> None:
    (moment,) = moments(1)
    figure = json.loads(figure_of_moments([moment], POSES[:, :2], title="").to_json())
    (trace,) = (trace for trace in figure["data"] if trace["name"] == "lines")
    x, y, told = (numbers(trace[name]) for name in ("x", "y", "customdata"))
    at = 0
    for begin, end in ends_of(moment.line_map):
        gap = at + int(np.argmax(np.isnan(x[at:])))
        np.testing.assert_allclose([[x[at], y[at]], [x[gap - 1], y[gap - 1]]], [begin, end], atol=1e-3)
        rho, theta, *_, length, times = told[at]
        normal = np.array([np.cos(np.deg2rad(theta)), np.sin(np.deg2rad(theta))])
        np.testing.assert_allclose([normal @ begin, normal @ end], rho, atol=2e-3)
        assert length == pytest.approx(np.linalg.norm(end - begin), abs=1e-3)
        assert times >= 1
        assert (told[at:gap] == told[at]).all()
        at = gap + 1
    assert at == len(x)
    assert "sliders" not in figure["layout"] or not figure["layout"]["sliders"]


def test_the_page_is_bounded_and_needs_no_network(tmp_path: Path) -> None:
    large = [Moment(random_map("float32", 1500, 600), 64 * i) for i in range(1, 31)]
    points = np.random.default_rng(0).normal(size=(10 * MOST_POINTS, 2))
    write_html(tmp_path / "map.html", large, np.zeros((1920, 2)), points, title="large")
    assert (tmp_path / "map.html").stat().st_size < 12_000_000
    page = (tmp_path / "map.html").read_text()
    assert "<script src" not in page
    assert "<link" not in page
    steps = page.count('"method":"animate"')
    assert 3 < steps < 30
    assert MOST_NUMBERS * 16 / 3 < 7_000_000


BROWSER = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)

SCRIPT = """<script>
window.addEventListener("load", async () => {
  const map = document.getElementById("map"), told = {};
  const until = async condition => {  // the page draws when it likes to
    for (let i = 0; i < 100 && !condition(); i++) await new Promise(done => setTimeout(done, 50));
  };
  const drawn = name => map._fullData.filter(t => t.name === name).map(t => Array.from(t.x).filter(isNaN).length)[0];
  const picture = async () => (await Plotly.toImage(map, {format: "png", width: 900, height: 700})).split(",")[1];
  told.asked = performance.getEntriesByType("resource").map(entry => entry.name).filter(n => !n.startsWith("data:"));
  const ranges = () => [map.layout.xaxis.range.slice(), map.layout.yaxis.range.slice()];
  told.ranges_before = ranges();
  told.lines = drawn("lines");
  told.steps = map.layout.sliders[0].steps.map(step => step.label);
  told.before = await picture();
  const rail = map.querySelector(".slider-rail-touch-rect"), box = rail.getBoundingClientRect();
  const press = {bubbles: true, clientX: box.left + 9, clientY: box.top + box.height / 2};
  rail.dispatchEvent(new MouseEvent("mousedown", press));
  document.dispatchEvent(new MouseEvent("mouseup", press));
  await until(() => drawn("lines") < told.lines);
  told.active = map.layout.sliders[0].active;
  told.lines_then = drawn("lines");
  const lines = () => Array.from(map.querySelectorAll(".scatterlayer path.js-line"))
    .filter(path => path.style.stroke === "rgb(8, 48, 107)");
  told.shown = lines().map(path => path.getTotalLength());
  Plotly.Fx.hover(map, [{curveNumber: map._fullData.findIndex(t => t.name === "lines"), pointNumber: 0}]);
  const hover = () => Array.from(map.querySelectorAll(".hoverlayer text")).map(t => t.textContent).join(" ");
  await until(hover);
  told.hover = hover();
  const entry = Array.from(map.querySelectorAll(".legend .traces")).find(g => g.textContent === "circles");
  const toggle = entry.querySelector(".legendtoggle"), there = toggle.getBoundingClientRect();
  const click = {bubbles: true, clientX: there.left + 2, clientY: there.top + 2};
  toggle.dispatchEvent(new MouseEvent("mousedown", click));
  toggle.dispatchEvent(new MouseEvent("mouseup", click));
  const hidden = () => map._fullData.filter(t => t.visible === "legendonly").map(t => t.name);
  await until(() => hidden().length);
  told.hidden = hidden();
  const plot = map.querySelector(".plotbg, .bglayer .bg, .xy").getBoundingClientRect();
  told.still = lines().map(path => path.getBoundingClientRect())
    .filter(box => box.width + box.height > 3 && box.left > plot.left && box.right < plot.right).length;
  told.ranges = ranges();
  told.after = await picture();
  fetch("/told", {method: "POST", body: JSON.stringify(told)});
});
</script>"""


def told_by_browser(browser: str, page: bytes, profile: Path) -> dict[str, Any]:
    """What a page that is shown by a browser posts to its server."""
    posted: Queue[bytes] = Queue()

    class Server(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_response(200 if self.path == "/" else 404)
            self.send_header("Content-Type", "text/html; charset=utf-8")
            self.end_headers()
            self.wfile.write(page if self.path == "/" else b"")

        def do_POST(self) -> None:
            posted.put(self.rfile.read(int(self.headers["Content-Length"])))
            self.send_response(204)
            self.end_headers()

        def log_message(self, format: str, *args: Any) -> None:
            pass

    with ThreadingHTTPServer(("127.0.0.1", 0), Server) as server:
        Thread(target=server.serve_forever, daemon=True).start()
        options = ["--headless", "--no-sandbox", "--disable-gpu", "--window-size=1200,900", "--remote-debugging-port=0"]
        offline = "--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE 127.0.0.1"
        address = f"http://127.0.0.1:{server.server_port}/"
        process = subprocess.Popen(
            [browser, *options, offline, f"--user-data-dir={profile}", address],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        try:
            return json.loads(posted.get(timeout=60))
        finally:
            process.terminate()
            process.wait(30)
            server.shutdown()


def test_the_page_in_a_browser(tmp_path: Path) -> None:
    if BROWSER is None:
        pytest.skip("no chromium on this machine: map.html was not tried in a browser")
    write_html(tmp_path / "map.html", moments(5), POSES[:, :2], POSES[:, :2] + 1, title="a <map>")
    page = (tmp_path / "map.html").read_text().replace("</body>", SCRIPT + "</body>")
    told = told_by_browser(BROWSER, page.encode(), tmp_path / "profile")

    assert [name for name in told["asked"] if not name.endswith("/favicon.ico")] == []
    assert told["steps"] == ["8", "16", "24", "32", "40"]
    assert (told["lines"], told["active"], told["lines_then"]) == (6, 0, 2)
    assert len(told["shown"]) == 2
    assert min(told["shown"]) > 5  # pixels
    assert "rho" in told["hover"]
    assert "detected" in told["hover"]
    assert told["still"] == 2
    assert told["ranges"] == told["ranges_before"]  # neither moments nor layers move the view
    assert told["hidden"] == ["circles", "circles"]  # the rims, and what answers to the pointer

    def drawn(picture: str, colour: tuple[int, int, int]) -> int:
        pixels = np.asarray(Image.open(BytesIO(base64.b64decode(picture))).convert("RGB"), int)
        return int((np.abs(pixels - colour).max(-1) < 25).sum())

    line, circle, path = (0x08, 0x30, 0x6B), (0x21, 0x71, 0xB5), (0x8A, 0x8A, 0x8A)
    (tmp_path / "before.png").write_bytes(base64.b64decode(told["before"]))
    (tmp_path / "after.png").write_bytes(base64.b64decode(told["after"]))
    assert drawn(told["before"], line) > drawn(told["after"], line) > 20
    assert drawn(told["before"], path) > drawn(told["after"], path) > 20
    assert drawn(told["before"], circle) > drawn(told["after"], circle)


def test_thinned_keeps_evenly_spaced_items() -> None:
    for most, parts in ((5, [3, 0, 4, 1, 20, 7]), (8, [100]), (1, [2, 2])):
        stream, at = Thinned[int](most), 0
        for count in parts:
            stream.extend(range(at, at + count))
            at += count
            assert len(stream.kept) <= most
            assert stream.kept == list(range(0, at, stream.every))
