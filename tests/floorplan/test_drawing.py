"""Drawings: DXF and SVG in the ways in which walls are drawn, units, layers, doors, and what is said of bad ones."""

import numpy as np
import pytest
import shapely

from polyexplore_gym.errors import FloorPlanWarning, InvalidConfigError, InvalidFloorPlanError, MissingDependencyError
from polyexplore_gym.floorplan import FAMILIES, FloorPlan, generate, load_plan, save_plan

ezdxf = pytest.importorskip("ezdxf")
pytest.importorskip("svgpathtools")


@pytest.fixture
def dxf(tmp_path):
    """Writes a drawing in millimetres, made by a function of the model space."""

    def save(draw, units=4):
        document = ezdxf.new("R2010", units=units)
        document.layers.add("WALLS", color=1)
        document.layers.add("DOORS", color=3)
        document.layers.add("HIDDEN", color=5).off()
        draw(document.modelspace(), document)
        document.saveas(tmp_path / "plan.dxf")
        return tmp_path / "plan.dxf"

    return save


@pytest.fixture
def svg(tmp_path):
    """Writes a drawing of these elements, a user unit a centimetre."""

    def save(body, head='viewBox="0 0 1000 600"'):
        namespaces = 'xmlns="http://www.w3.org/2000/svg" xmlns:xlink="http://www.w3.org/1999/xlink"'
        inkscape = 'xmlns:inkscape="http://www.inkscape.org/namespaces/inkscape"'
        (tmp_path / "plan.svg").write_text(f"<svg {namespaces} {inkscape} {head}>{body}</svg>", encoding="utf-8")
        return tmp_path / "plan.svg"

    return save


def lines(space, points, layer="WALLS", closed=True):
    """The sides of a ring as single lines, mm."""
    points = [(1000 * x, 1000 * y) for x, y in points]
    for a, b in zip(points, points[1:] + points[:1] if closed else points[1:], strict=False):
        space.add_line(a, b, dxfattribs={"layer": layer})


def ring(space, points, layer="WALLS"):
    space.add_lwpolyline([(1000 * x, 1000 * y) for x, y in points], close=True, dxfattribs={"layer": layer})


def box(x0, y0, x1, y1):
    return [(x0, y0), (x1, y0), (x1, y1), (x0, y1)]


def assert_same(plan, expected, tolerance=1e-6):
    assert plan.polygon.symmetric_difference(expected).area < tolerance


@pytest.mark.parametrize("suffix", [".dxf", ".svg"])
@pytest.mark.parametrize("family", FAMILIES)
def test_round_trip(tmp_path, family, suffix):
    plan = generate(family, 11)
    save_plan(plan, tmp_path / f"plan{suffix}")
    again = load_plan(tmp_path / f"plan{suffix}")
    assert again.content_hash == plan.content_hash
    assert again.meta["format"] == suffix[1:].upper()


def test_outline_and_obstacles_as_polylines_and_lines(dxf):
    def draw(space, _):
        lines(space, box(0, 0, 8, 5))
        ring(space, box(2, 2, 3, 3))
        lines(space, box(5, 1, 6, 4))
        lines(space, box(5.2, 1.2, 5.8, 3.8))  # a room in an obstacle
        ring(space, box(-9, -9, 20, 20), "HIDDEN")
        space.add_text("kitchen", dxfattribs={"layer": "WALLS"})

    with pytest.warns(FloorPlanWarning, match="reaches 96 %"):
        plan = load_plan(dxf(draw))
    assert_same(plan, shapely.box(0, 0, 8, 5) - shapely.box(2, 2, 3, 3) - shapely.box(5, 1, 6, 4))


def test_arcs_circles_splines_and_blocks(dxf):
    def draw(space, document):
        # A bay: the lower side is half a circle.
        space.add_line((0, 0), (0, 5000), dxfattribs={"layer": "WALLS"})
        space.add_lwpolyline([(0, 5000), (8000, 5000), (8000, 0)], dxfattribs={"layer": "WALLS"})
        space.add_arc((4000, 0), 4000, 180, 360, dxfattribs={"layer": "WALLS"})
        block = document.blocks.new("COLUMN")
        block.add_circle((0, 0), 1, dxfattribs={"layer": "0"})
        for x in (2000, 6000):
            where = {"layer": "WALLS", "xscale": 300, "yscale": 300}
            space.add_blockref("COLUMN", (x, 2500), dxfattribs=where)
        block.add_attdef("NAME", (0, 0))

    plan = load_plan(dxf(draw), layers=["walls"])
    expected = shapely.box(0, 0, 8, 5) | shapely.Point(4, 0).buffer(4, quad_segs=100).intersection(
        shapely.box(0, -4, 8, 0)
    )
    expected -= shapely.union_all([shapely.Point(x, 2.5).buffer(0.3, quad_segs=100) for x in (2, 6)])
    assert_same(plan, expected, 0.15)
    assert len(plan.holes) == 2
    finer = load_plan(dxf(draw), tolerance=0.001)
    assert finer.n_vertices > plan.n_vertices
    assert_same(finer, expected, 0.015)


def two_rooms(space, gap):
    """Walls as solid closed lines: two rooms, a partition with a gap from (4, 2)."""
    ring(space, box(-0.2, -0.2, 8.2, 5.2))
    ring(space, box(0, 0, 8, 5))
    ring(space, box(3.9, 0.1, 4.1, 2))
    if gap < 3:
        ring(space, box(3.9, 2 + gap, 4.1, 4.9))


def test_lines_drawn_twice_count_once(dxf):
    def draw(space, _):
        for _ in range(2):
            ring(space, box(0, 0, 8, 5))
            ring(space, box(2, 2, 3, 3)[::-1])

    assert_same(load_plan(dxf(draw)), shapely.box(0, 0, 8, 5) - shapely.box(2, 2, 3, 3))


def test_walls_as_areas(dxf):
    plan = load_plan(dxf(lambda space, _: two_rooms(space, 1.0)), walls="areas")
    solid = shapely.box(3.9, 0.1, 4.1, 2) | shapely.box(3.9, 3, 4.1, 4.9)
    assert_same(plan, shapely.box(0, 0, 8, 5) - solid)


def test_walls_as_areas_that_overlap(dxf):
    """Outer walls as four beams, a partition that reaches into two of them."""
    beams = [box(-0.2, -0.2, 8.2, 0), box(-0.2, 5, 8.2, 5.2), box(-0.2, -0.2, 0, 5.2), box(8, -0.2, 8.2, 5.2)]

    def draw(space, _):
        for beam in beams:
            ring(space, beam)
        ring(space, box(3.9, -0.1, 4.1, 3.5))

    def bands(space, _):
        ring(space, box(-0.2, -0.2, 8.2, 5.2))
        ring(space, box(0, 0, 8, 5))
        ring(space, box(3.9, -0.1, 4.1, 3.5))

    for drawn in (draw, bands):
        plan = load_plan(dxf(drawn), walls="areas", radius=0.25)
        assert_same(plan, shapely.box(0, 0, 8, 5) - shapely.box(3.9, 0, 4.1, 3.5))
        with pytest.raises(InvalidFloorPlanError, match=r"closed lines overlap at .*--walls areas"):
            load_plan(dxf(drawn))


def test_lines_that_branch_are_no_outline(dxf):
    def draw(space, _):
        for a, b in (
            ((0, 0), (4, 0)),
            ((4, 0), (8, 0)),
            ((8, 0), (8, 5)),
            ((8, 5), (0, 5)),
            ((0, 5), (0, 0)),
            ((4, 0), (4, 3)),
        ):
            lines(space, [a, b], closed=False)
        lines(space, [(4, 3), (8, 5)], closed=False)

    with pytest.raises(InvalidFloorPlanError, match=r"3 lines meet at \(4\.000, 0\.000\), .*--walls lines"):
        load_plan(dxf(draw))


def test_walls_as_lines_of_a_thickness_and_doors_by_layer(dxf):
    def draw(space, _):
        lines(space, box(0, 0, 8, 5))
        space.add_line((4000, 0), (4000, 5000), dxfattribs={"layer": "WALLS"})
        # A door leaf of 0.9 m with its swing.
        lines(space, [(4.05, 2), (4.95, 2)], "DOORS", closed=False)
        space.add_arc((4050, 2000), 900, 0, 90, dxfattribs={"layer": "DOORS"})

    path = dxf(draw)
    with pytest.raises(InvalidFloorPlanError, match=r"do not close: ends at .*--walls lines"):
        load_plan(path)
    rooms = [shapely.box(0.05, 0.05, 3.95, 4.95), shapely.box(4.05, 0.05, 7.95, 4.95)]
    with pytest.warns(FloorPlanWarning, match="reaches 50 %"):
        closed = load_plan(path, walls="lines", layers=["WALLS"], radius=0.25)
    assert_same(closed, rooms[0], 1e-6) if closed.bounds[0] < 1 else assert_same(closed, rooms[1], 1e-6)
    plan = load_plan(path, walls="lines", doors=["doors"], radius=0.25)
    assert_same(plan, rooms[0] | rooms[1] | shapely.box(3.95, 2, 4.05, 2.9), 1e-3)
    thick = load_plan(path, walls="lines", wall_thickness=0.3, doors=["3"], radius=0.25)
    assert thick.bounds == pytest.approx((0.15, 0.15, 7.85, 4.85))


def test_doors_join_rooms_of_an_outline(dxf):
    def draw(space, _):
        ring(space, box(0, 0, 4, 5))
        ring(space, box(4.2, 0, 8, 5))
        ring(space, box(4, 2, 4.2, 3), "DOORS")

    with pytest.warns(FloorPlanWarning, match="is not connected with it"):
        load_plan(dxf(draw), layers=["WALLS"])
    plan = load_plan(dxf(draw), doors=["DOORS"], radius=0.25)
    assert_same(plan, shapely.box(0, 0, 4, 5) | shapely.box(4.2, 0, 8, 5) | shapely.box(4, 2, 4.2, 3), 0.005)


def test_what_did_not_close_and_where(dxf):
    def draw(space, _):
        lines(space, [(0, 0), (8, 0), (8, 5), (0, 5), (0, 0.03)], closed=False)

    path = dxf(draw)
    with pytest.raises(
        InvalidFloorPlanError, match=r"plan\.dxf: lines do not close: ends at \(0\.000, 0\.0[03]0\), 0\.03 m"
    ):
        load_plan(path)
    assert load_plan(path, snap=0.05).area == pytest.approx(40, abs=0.2)


@pytest.mark.parametrize("walls", ["lines", "areas"])
def test_an_opening_in_the_walls_and_where(dxf, walls):
    def draw(space, _):
        if walls == "lines":
            lines(space, [(3, 0), (0, 0), (0, 5), (8, 5), (8, 0), (4, 0)], closed=False)
            lines(space, [(0, 4), (1, 4), (1, 5)], closed=False)  # a closed cupboard is not the floor
        else:
            for part in (box(0, 0, 3, 0.1), box(4, 0, 8, 0.1), box(0, 0, 0.1, 5), box(7.9, 0, 8, 5), box(0, 4.9, 8, 5)):
                ring(space, part)

    with pytest.raises(InvalidFloorPlanError) as caught:
        load_plan(dxf(draw), walls=walls, layers=["WALLS"])
    text = str(caught.value)
    assert "an opening of about 0.9" in text or "an opening of about 1.0" in text
    x, y = map(float, text.split(" m at (")[1].split(")")[0].split(", "))
    assert abs(x - 3.5) < 0.5
    assert abs(y) < 0.6


def test_units_are_read_or_asked_for(dxf):
    def draw(space, _):
        ring(space, box(0, 0, 8, 5))

    assert load_plan(dxf(draw)).area == pytest.approx(40)
    assert load_plan(dxf(draw, units=5)).area == pytest.approx(4000)
    assert load_plan(dxf(draw, units=5), units="mm").area == pytest.approx(40)
    with pytest.raises(InvalidFloorPlanError, match=r"\$INSUNITS 0: .*--units mm"):
        load_plan(dxf(draw, units=0))
    with pytest.raises(InvalidFloorPlanError, match=r"spans 8000 x 5000 m .*in mm: 8 x 5 m"):
        load_plan(dxf(draw, units=6))


def test_coordinates_of_a_survey(dxf):
    path = dxf(lambda space, _: ring(space, [(431_200 + x, 5_073_100 + y) for x, y in box(0, 0, 8, 5)]))
    with pytest.warns(FloorPlanWarning, match="is taken off all of them"):
        plan = load_plan(path)
    assert_same(plan, shapely.box(0, 0, 8, 5))


def test_layers_and_colours_are_named(dxf):
    path = dxf(lambda space, _: (ring(space, box(0, 0, 8, 5)), ring(space, box(1, 1, 2, 2), "DOORS"))[0])
    with pytest.raises(InvalidFloorPlanError, match=r"layers 'wand': the drawing has '1', '3', 'doors', 'walls'"):
        load_plan(path, layers=["wand"])
    assert load_plan(path, layers=["1"]).area == pytest.approx(40)
    assert load_plan(path, layers=["walls", "3"]).area == pytest.approx(39)
    with pytest.raises(InvalidFloorPlanError, match="no lines for walls"):
        load_plan(path, layers=["doors"], doors=["doors"])


def test_svg_shapes_transforms_and_styles(svg):
    path = svg(
        '<g inkscape:label="Walls" transform="translate(100 50)"><rect width="800" height="500" stroke="#f00"/></g>'
        '<g id="things" style="stroke: rgb(0, 0, 255)"><circle cx="300" cy="200" r="30"/>'
        '<polygon points="500,100 600,100 600,200"/>'
        '<path d="M 500 300 h 100 v 50 h -100 z m 200 0 l 50 0 l 0 50 z"/>'
        '<path d="M 200 400 C 200 450 300 450 300 400 Z" transform="rotate(0)"/></g>'
        '<g style="display:none"><rect width="5000" height="5000"/></g>'
        '<defs><rect id="hidden" width="9000" height="10"/></defs><text x="3" y="4">hall</text>'
    )
    with pytest.raises(InvalidFloorPlanError, match=r"user unit.*spans 800 x 500 user units \(in cm: 8 x 5 m"):
        load_plan(path)
    plan = load_plan(path, units="cm")
    assert plan.bounds == pytest.approx((1, -5.5, 9, -0.5))
    assert len(plan.holes) == 5
    bezier = 0.75 * 1.0 * 0.5 * 0.8
    expected = 40 - np.pi * 0.3**2 - 0.5 - 0.5 - 0.125
    assert plan.area == pytest.approx(expected - bezier, abs=0.03)
    assert load_plan(path, units="cm", layers=["walls"]).area == pytest.approx(40)
    assert load_plan(path, units=0.01, layers=["#FF0000", "#0000ff"]).n_vertices == plan.n_vertices
    with pytest.raises(InvalidFloorPlanError, match=r"layers 'wall': the drawing has '#0000ff', '#ff0000', 'things'"):
        load_plan(path, units="cm", layers=["wall"])


def test_svg_use_and_open_lines(svg):
    path = svg(
        '<polyline points="0,0 800,0 800,500"/><path d="M800,500 H0 V0"/>'
        '<symbol id="s"/><rect id="r" x="100" y="100" width="50" height="50"/><use xlink:href="#r" x="200"/>'
    )
    plan = load_plan(path, units="cm")
    assert_same(plan, shapely.box(0, -5, 8, 0) - shapely.box(1, -1.5, 1.5, -1) - shapely.box(3, -1.5, 3.5, -1))


@pytest.mark.parametrize(
    ("body", "message"),
    [
        ('<path id="p" d="M 0 0 L 1 x"/>', "path 'p': damaged"),
        ('<polygon points="0,0 1,1 2"/>', "polygon: damaged"),
        ('<polygon points="0,0 1,a 2,2"/>', "polygon: damaged"),
        ('<circle r="nan"/>', "circle: damaged"),
        ('<rect width="10%" height="3"/>', "rect: damaged"),
        ('<g transform="turn(3)"><rect width="1" height="1"/></g>', "transform"),
        ("", "no lines for walls"),
        ('<rect width="1e300" height="1e300"/>', "too large"),
        ('<use xlink:href="#u" id="u"/>', "no lines for walls"),
    ],
)
def test_damaged_svg(svg, body, message):
    with pytest.raises(InvalidFloorPlanError, match=message):
        load_plan(svg(body), units="cm")


def test_svg_entities_are_not_unfolded(tmp_path):
    (tmp_path / "a.svg").write_text('<!DOCTYPE svg [<!ENTITY a "b">]><svg xmlns="http://www.w3.org/2000/svg">&a;</svg>')
    with pytest.raises(InvalidFloorPlanError, match="entities"):
        load_plan(tmp_path / "a.svg", units="m")


def test_options_out_of_range(tmp_path):
    for options in ({"walls": "brick"}, {"snap": -1.0}, {"snap": np.nan}, {"wall_thickness": 11.0}, {"tolerance": "x"}):
        with pytest.raises(InvalidConfigError, match=f"PlanFileConfig.{next(iter(options))}"):
            load_plan(tmp_path / "a.dxf", **options)


def test_without_the_extra(tmp_path, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "ezdxf", None)
    monkeypatch.setitem(__import__("sys").modules, "svgpathtools", None)
    plan = FloorPlan.create([[0, 0], [1, 0], [1, 1]])
    save_plan(plan, tmp_path / "a.svg")
    for call in (lambda: save_plan(plan, tmp_path / "a.dxf"), lambda: load_plan(tmp_path / "a.svg")):
        with pytest.raises(MissingDependencyError, match=r"polyexplore-gym\[drawings\]"):
            call()
