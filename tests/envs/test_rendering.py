import copy
import pickle
import time

import forked
import numpy as np
import pytest
from drawn import check_looks
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import EllipseCollection
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse
from matplotlib.text import Text

from slamgym.envs.bearing_range import LineOfSight
from slamgym.envs.controllers import planned_path
from slamgym.envs.rendering import RenderState, WorldRenderer
from slamgym.envs.rendering.render_state import AxesLimits, visible_area
from slamgym.envs.rendering.scene import Clock
from slamgym.sim_configs import action_sequence, load_scenario

LANDMARKS = np.array([[3.0, 6.0], [3.0, 12.0], [7.0, 8.0], [7.0, 14.0], [11.0, 6.0]])
SIX = load_scenario("six_landmarks")


class FixedBelief:
    """A belief with one large and one small landmark ellipse."""

    pose = np.array([2.5, 0.5, 0.1])
    landmarks = np.array([[3.1, 5.9], [7.2, 8.1]])
    covariance = np.diag([0.2, 0.1, 0.01, 0.5, 0.3, 0.04, 0.09])
    covariance[3, 4] = covariance[4, 3] = 0.2
    pose_covariance = covariance[:3, :3]


def snapshot(pose=(2.0, 1.0, 0.5), **changes):
    pose = np.array(pose, dtype=float)
    offset = LANDMARKS - pose[:2]
    readings = np.stack(
        [np.arctan2(*offset.T[::-1]) - pose[2], np.linalg.norm(offset, axis=1)], axis=1
    )
    path = np.array([[0.0, 0.0], pose[:2]])
    return RenderState(pose, path, readings, False, None, 3.0, 1)._replace(**changes)


@pytest.fixture
def renderer():
    renderer = WorldRenderer(SIX, LANDMARKS, "rgb_array", size_px=300)
    yield renderer
    renderer.close()


def scene_of(renderer):
    return renderer._drawing.scene


def moving_parts(renderer):
    return scene_of(renderer)._moving


def figure_of(renderer):
    return scene_of(renderer).moving[0].figure


def share_of_different_pixels(one, other):
    return np.mean((one != other).any(axis=-1))


@pytest.mark.parametrize("size", [100, 127, 600])
def test_frame_is_a_square_of_the_asked_size(size):
    frame = WorldRenderer(SIX, LANDMARKS, "rgb_array", size).render(snapshot())
    assert frame.shape == (size, size, 3)
    assert frame.dtype == np.uint8
    assert len(np.unique(frame.reshape(-1, 3), axis=0)) > 10


def test_frames_are_fresh_arrays(renderer):
    first = renderer.render(snapshot())
    kept = first.copy()
    second = renderer.render(snapshot((6.0, 3.0, 2.0)))
    np.testing.assert_array_equal(first, kept)
    assert not np.shares_memory(first, second)


def test_moving_leaves_no_trace_of_former_frames(renderer):
    last = snapshot((6.0, 3.0, 2.0), step=9)
    for moment in (
        snapshot(belief=FixedBelief()),
        snapshot(collision=True),
        snapshot((3.0, 3.0, 1.0), measurements=np.empty((0, 2))),
    ):
        renderer.render(moment)
    fresh = WorldRenderer(SIX, LANDMARKS, "rgb_array", size_px=300)
    fresh.render(snapshot(belief=FixedBelief()))  # whose legend then names it, too
    np.testing.assert_array_equal(renderer.render(last), fresh.render(last))


def test_blitted_frame_is_nearly_that_of_a_full_draw(renderer):
    moment = snapshot(belief=FixedBelief(), collision=True)
    renderer.render(snapshot((6.0, 3.0, 2.0), belief=FixedBelief()))
    blitted = renderer.render(moment)
    for artist in scene_of(renderer).moving:
        artist.set_animated(False)
    canvas = figure_of(renderer).canvas
    with canvas.callbacks.blocked(signal="draw_event"):  # draws no moving part twice
        canvas.draw()
    full = np.asarray(canvas.buffer_rgba())[..., :3]
    assert share_of_different_pixels(blitted, full) < 0.01


@pytest.mark.slow
def test_blitting_is_several_times_faster_than_drawing_everything(renderer):
    moments = [snapshot((2.0 + 0.1 * k, 1.0, 0.5)) for k in range(12)]
    renderer.render(moments[0])

    def fastest(prepare):
        times = []
        for moment in moments:
            prepare()
            start = time.thread_time()
            renderer.render(moment)
            times.append(time.thread_time() - start)
        return min(times)

    assert fastest(renderer._drawing.blitted.outdate) > 2.5 * fastest(lambda: None)


def test_rays_of_exact_readings_end_at_the_landmarks(renderer):
    renderer.render(snapshot())
    segments = np.array(moving_parts(renderer).rays.get_segments())
    np.testing.assert_allclose(segments[:, 1], LANDMARKS, atol=1e-12)
    np.testing.assert_allclose(segments[:, 0], np.tile([2.0, 1.0], (5, 1)))


def test_belief_is_drawn_as_ellipses_of_three_sigma(renderer):
    renderer.render(snapshot(belief=FixedBelief()))
    moving = moving_parts(renderer)
    for shown, means, blocks in (
        (moving.pose_ellipse, [FixedBelief.pose[:2]], [np.diag([0.2, 0.1])]),
        (
            moving.map_ellipses,
            FixedBelief.landmarks,
            [FixedBelief.covariance[3:5, 3:5], FixedBelief.covariance[5:, 5:]],
        ),
    ):
        np.testing.assert_allclose(shown.get_offsets(), means)
        axes = np.stack([shown.get_heights(), shown.get_widths()], axis=1)
        np.testing.assert_allclose(axes, 6 * np.sqrt(np.linalg.eigvalsh(blocks)))
        assert shown.get_visible()


def test_belief_without_landmarks_is_drawn(renderer):
    class Lost(FixedBelief):
        landmarks = np.empty((0, 2))
        covariance = FixedBelief.pose_covariance

    renderer.render(snapshot(belief=Lost()))
    assert len(moving_parts(renderer).map_ellipses.get_widths()) == 0


def test_arrow_points_along_the_heading(renderer):
    renderer.render(snapshot((2.0, 1.0, 2.1)))
    tip = moving_parts(renderer).arrow.get_xy()[0] - [2.0, 1.0]
    assert np.arctan2(tip[1], tip[0]) == pytest.approx(2.1)


def test_collision_is_shown(renderer):
    frames = []
    for hit in (False, True, False):
        frames.append(renderer.render(snapshot(collision=hit)))
        parts = moving_parts(renderer)
        assert parts.alarm.get_visible() == parts.halo.get_visible() == hit
    assert share_of_different_pixels(*frames[:2]) > 0.001
    assert (frames[2] == frames[0]).all()
    assert parts.alarm.get_text() == "collision"


def test_field_of_view_is_a_wedge_about_the_heading():
    narrow = SIX.with_changes(sensor={"field_of_view": 1.0, "max_range": 4.0})
    renderer = WorldRenderer(narrow, LANDMARKS, "rgb_array", size_px=200)
    renderer.render(snapshot((2.0, 1.0, 0.5)))
    outline = moving_parts(renderer).view.get_xy() - [2.0, 1.0]
    distance = np.linalg.norm(outline, axis=1)
    bearing = np.arctan2(*outline[distance > 1].T[::-1]) - 0.5
    assert distance.max() == pytest.approx(4.0)
    assert distance.min() == pytest.approx(0.0)
    assert (bearing.min(), bearing.max()) == pytest.approx((-0.5, 0.5))


def test_unlimited_view_is_not_drawn(renderer):
    renderer.render(snapshot())
    assert np.isnan(moving_parts(renderer).view.get_xy()).all()
    world = SIX.with_changes(name="$\\frac$", sensor={"field_of_view": 1.0})
    wedge = WorldRenderer(world, LANDMARKS, "rgb_array", size_px=200)
    wedge.render(snapshot())
    assert np.isfinite(moving_parts(wedge).view.get_xy()).all()


def test_clock_tells_step_and_time(renderer):
    renderer.render(snapshot(step=7, time=20.5))
    assert moving_parts(renderer).clock.get_text() == "step 7/29   20.5 s"


def ink(artist):
    """Draw one artist alone; return the darkness of its pixels."""
    figure = Figure(figsize=(6, 1))
    canvas = FigureCanvasAgg(figure)
    figure.add_artist(artist)
    for dpi in (50, 100):
        figure.set_dpi(dpi)
        canvas.draw()
    return 255.0 - np.asarray(canvas.buffer_rgba())[..., 0]


def test_the_clock_looks_like_text_of_matplotlib():
    clock = Clock(0.9, 0.4, "black")
    clock.set_text("step 107/1005   26.5 s")
    text = Text(0.9, 0.4, clock.get_text(), fontsize=11, ha="right")
    here, there = ink(clock), ink(text)
    assert here.sum() == pytest.approx(there.sum(), rel=0.1)
    assert np.corrcoef(here.mean(axis=1), there.mean(axis=1))[0, 1] > 0.9
    for axis in (0, 1):
        ends, usual = (np.flatnonzero(image.max(axis) > 99) for image in (here, there))
        assert abs(ends[-1] - usual[-1]) <= 1
        assert abs(ends[0] - usual[0]) <= 0.05 * (usual[-1] - usual[0]) + 1


@pytest.mark.parametrize(
    "sensor",
    [
        {},
        {"max_range": 5.0},
        {"max_range": 5.0, "identities": False, "clutter": 1.0, "max_clutter": 5},
    ],
)
@pytest.mark.parametrize("walls", [(), ((0.0, 0.0, 5.0, 0.0),)])
def test_texts_stay_inside_the_figure_and_apart(sensor, walls):
    scenario = SIX.with_changes(sensor=sensor, walls=walls)
    renderer = WorldRenderer(scenario, LANDMARKS, "rgb_array")
    renderer.render(snapshot(belief=FixedBelief(), collision=True))
    figure = figure_of(renderer)
    legend = figure.legends[0].get_window_extent()
    assert figure.bbox.x0 <= legend.x0
    assert legend.x1 <= figure.bbox.x1
    xlabel = figure.axes[0].xaxis.label.get_window_extent()
    assert legend.y1 < xlabel.y0
    name, alarm, clock = (
        text.get_window_extent()
        for text in sorted(figure.artists, key=lambda t: t.get_window_extent().x0)
    )
    assert name.x1 < alarm.x0 < alarm.x1 < clock.x0 < clock.x1 < figure.bbox.x1


def test_axes_are_in_metres_of_equal_length(renderer):
    renderer.render(snapshot())
    axes = figure_of(renderer).axes[0]
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("x [m]", "y [m]")
    scale = axes.transData.transform([[0, 0], [1, 1]])
    assert np.ptp(scale, axis=0)[0] == pytest.approx(np.ptp(scale, axis=0)[1])


def inside(limits, points):
    x, y = np.transpose(points)
    return (
        (limits.x[0] < x) & (x < limits.x[1]) & (limits.y[0] < y) & (y < limits.y[1])
    ).all()


def test_view_holds_landmarks_walls_start_and_planned_path():
    scenario = SIX.with_changes(walls=((-40.0, 3.0, -30.0, 3.0),))
    limits = AxesLimits(scenario, LANDMARKS, aspect=1.0)
    pose, path = np.array(scenario.start.pose), []
    for speed, rate in action_sequence(scenario):
        path.append(pose[:2].copy())
        pose[:2] += speed * scenario.dt * np.array([np.cos(pose[2]), np.sin(pose[2])])
        pose[2] += rate * scenario.dt
    assert inside(limits, [*LANDMARKS, [-40, 3], [-30, 3], *path, pose[:2]])


def test_view_follows_a_robot_that_leaves_it_and_returns_with_the_episode():
    limits = AxesLimits(SIX, LANDMARKS, aspect=1.2)
    first = limits.x, limits.y
    assert not limits.follow(snapshot())
    assert limits.follow(snapshot((90.0, -20.0, 0.0)))
    assert inside(limits, [*LANDMARKS, [90.0, -20.0]])
    assert np.ptp(limits.x) == pytest.approx(1.2 * np.ptp(limits.y))
    assert not limits.follow(snapshot((91.0, -20.0, 0.0)))
    assert limits.follow(snapshot(step=0))
    assert (limits.x, limits.y) == first


def fitted(low, high, aspect):
    """Return the corners of a rectangle, enlarged about its centre to an aspect."""
    width = max(high[0] - low[0], (high[1] - low[1]) * aspect)
    half, centre = np.array([width, width / aspect]) / 2, (low + high) / 2
    return np.stack([centre - half, centre + half])


@pytest.mark.parametrize("aspect", [1.0, 1.7])
@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("side", [0, 1])
def test_the_view_grows_where_the_robot_comes_near_its_border(aspect, axis, side):
    limits = AxesLimits(SIX, LANDMARKS, aspect)
    box = np.stack([limits.x, limits.y], axis=1)
    points = np.concatenate([LANDMARKS, planned_path(SIX)[:, :2]])
    low, high = points.min(axis=0), points.max(axis=0)
    room = 0.06 * (high - low).max()
    np.testing.assert_allclose(box, fitted(low - room, high + room, aspect))
    span, place = (box[1] - box[0]).max(), box.mean(axis=0)
    for inside, changes in ((0.0201, False), (0.0199, True)):
        place[axis] = box[side, axis] + (0.5 - side) * 2 * inside * span
        moment = snapshot((*place, 0.0), path=box.mean(axis=0)[None])
        assert limits.follow(moment) == changes
    grown = box.copy()
    grown[side, axis] = place[axis] - (0.5 - side) * 2 * 0.25 * span
    expected = fitted(*grown, aspect)
    np.testing.assert_allclose([limits.x, limits.y], expected.T)
    again = AxesLimits(SIX, LANDMARKS, aspect)
    middle = (*box.mean(axis=0), 0.0)
    assert again.follow(snapshot(middle, path=place[None]))  # the path counts, too
    np.testing.assert_allclose([again.x, again.y], expected.T)


def test_a_view_has_room_for_eight_radii_of_the_robot():
    still = {"sequence": "commands", "commands": [(0.0, 0.0, 1)]}
    world = SIX.with_changes(controls=still, robot={"radius": 2.0})
    limits = AxesLimits(world, np.array([[0.0, 0.0], [3.0, 0.0]]), aspect=1.0)
    assert np.ptp(limits.x) == pytest.approx(16.0)


def test_frame_after_leaving_the_view_shows_the_robot(renderer):
    renderer.render(snapshot())
    frame = renderer.render(snapshot((90.0, -20.0, 0.0)))
    fresh = WorldRenderer(SIX, LANDMARKS, "rgb_array", size_px=300)
    np.testing.assert_array_equal(frame, fresh.render(snapshot((90.0, -20.0, 0.0))))
    axes = figure_of(renderer).axes[0]
    pixel = axes.transData.transform([90.0, -20.0])
    assert axes.bbox.contains(*pixel)


def test_world_of_one_point_has_a_view():
    scenario = SIX.with_changes(
        controls={"sequence": "commands", "commands": [(0.0, 0.0, 1)]}
    )
    limits = AxesLimits(scenario, np.zeros((1, 2)), aspect=1.0)
    assert np.ptp(limits.x) > 0


@pytest.mark.slow
def test_renderer_is_copied_and_pickled_without_its_figure(renderer):
    frame = renderer.render(snapshot())
    for twin in (pickle.loads(pickle.dumps(renderer)), copy.deepcopy(renderer)):
        np.testing.assert_array_equal(twin.render(snapshot()), frame)


def test_closing_twice_and_drawing_again_is_fine(renderer):
    frame = renderer.render(snapshot())
    renderer.close()
    renderer.close()
    np.testing.assert_array_equal(renderer.render(snapshot()), frame)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"mode": "ansi"}, "mode must be 'rgb_array' or 'human', got 'ansi'"),
        ({"mode": "rgb_array", "size_px": 20}, "size_px must be >= 100, got 20"),
        ({"mode": "human", "fps": 0.0}, "fps must be a finite number > 0, got 0.0"),
    ],
)
def test_wrong_arguments_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        WorldRenderer(SIX, LANDMARKS, **arguments)


@pytest.fixture
def pyplot():
    from matplotlib import pyplot

    pyplot.switch_backend("agg")
    yield pyplot
    assert pyplot.get_fignums() == []


@pytest.fixture
def screen(pyplot, monkeypatch):
    """Pretend that Agg had windows, and record how long they were served."""
    served, canvas = [], FigureCanvasAgg
    monkeypatch.setattr(canvas, "required_interactive_framework", "test")
    monkeypatch.setattr(Figure, "show", lambda self: None)
    monkeypatch.setattr(canvas, "blit", lambda self, box: None)
    monkeypatch.setattr(canvas, "start_event_loop", lambda _, time: served.append(time))
    return served


def test_more_windows_than_matplotlib_expects_are_no_warning(screen, pyplot):
    renderers = [WorldRenderer(SIX, LANDMARKS, "human") for _ in range(25)]
    for renderer in renderers:
        renderer.render(snapshot())
    assert len(pyplot.get_fignums()) == 25
    for renderer in renderers:
        renderer.close()


def test_human_mode_without_windows_says_so_once_and_returns_none(pyplot, caplog):
    renderer = WorldRenderer(SIX, LANDMARKS, "human")
    for _ in range(3):
        assert renderer.render(snapshot()) is None
    assert [record.message for record in caplog.records] == [
        "matplotlib's backend 'agg' has no windows: mode 'human' shows nothing"
    ]
    renderer.close()
    renderer.close()


def test_human_mode_draws_in_the_window_what_the_array_would_show(screen, pyplot):
    renderer = WorldRenderer(SIX, LANDMARKS, "human")
    renderer.render(snapshot((6.0, 3.0, 2.0)))
    renderer.render(snapshot())
    shown = np.asarray(pyplot.gcf().canvas.buffer_rgba())[..., :3]
    frame = WorldRenderer(SIX, LANDMARKS, "rgb_array").render(snapshot())
    np.testing.assert_array_equal(shown, frame)
    renderer.close()


def test_human_mode_serves_the_window_until_the_next_frame_is_due(screen, pyplot):
    renderer = WorldRenderer(SIX, LANDMARKS, "human", fps=0.1)
    renderer.render(snapshot())
    renderer.render(snapshot())
    renderer.close()
    assert 0 < screen[0] <= 10
    assert screen[0] < screen[1] <= 20  # nothing was waited for in between


def test_window_that_its_user_closed_stays_closed(screen, pyplot):
    renderer = WorldRenderer(SIX, LANDMARKS, "human")
    renderer.render(snapshot())
    pyplot.close("all")
    assert renderer.render(snapshot()) is None
    assert pyplot.get_fignums() == []
    renderer.close()


def loaded_modules(program):
    code = f"{forked.WITHOUT_MATPLOTLIB}{program}\nprint(*sys.modules)"
    return set(forked.run(code).stdout.split())


def test_environments_are_imported_without_matplotlib():
    modules = loaded_modules("import slamgym.envs")
    assert "slamgym.envs" in modules
    assert "matplotlib" not in modules


@pytest.mark.slow
def test_arrays_are_rendered_without_pyplot():
    modules = loaded_modules("import slamgym.envs.rendering.renderer")
    assert "matplotlib" in modules
    assert "matplotlib.pyplot" not in modules


def test_ellipses_are_in_data_coordinates(renderer):
    renderer.render(snapshot())
    shown = [a for a in scene_of(renderer).moving if isinstance(a, EllipseCollection)]
    assert {artist._units for artist in shown} == {"xy"}


def test_the_view_ends_at_walls_that_hide():
    """Every corner of the outline has a free line of sight, and a wall or the range."""
    corridor = load_scenario("corridor")
    pose = np.array([0.3, 0.2, 0.4])
    walls = np.reshape(corridor.walls, (-1, 2, 2))
    area = visible_area(pose, 2 * np.pi, 8.0, walls)
    sight, frame = LineOfSight(corridor.walls), pose[:, None]
    inner = pose[:2] + (1 - 1e-6) * (area - pose[:2])
    outer = pose[:2] + (1 + 1e-4) * (area - pose[:2])
    assert not sight.blocked((inner @ np.array([1, 1j]))[None], frame).any()
    ended = np.linalg.norm(area - pose[:2], axis=1) < 8.0 - 1e-9
    assert 10 < ended.sum() < len(area)
    assert sight.blocked((outer[ended] @ np.array([1, 1j]))[None], frame).all()
    free = visible_area(pose, 2 * np.pi, 8.0, walls[:0])
    assert np.linalg.norm(free - pose[:2], axis=1) == pytest.approx(8.0)


def test_walls_that_hide_nothing_do_not_cut_the_view():
    wall = ((3.0, -9.0, 3.0, 9.0),)
    for occlusion, farthest in ((False, 6.0), (True, 3.0)):
        world = SIX.with_changes(
            walls=wall, sensor={"max_range": 4.0, "occlusion": occlusion}
        )
        renderer = WorldRenderer(world, LANDMARKS, "rgb_array", size_px=200)
        renderer.render(snapshot((2.0, 1.0, 0.5)))
        outline = moving_parts(renderer).view.get_xy()
        assert outline[:, 0].max() == pytest.approx(farthest, abs=0.01)


def test_a_large_world_is_shown_around_the_robot():
    city = load_scenario("city")
    landmarks = np.array([[0.0, 0.0], [250.0, 250.0]])
    limits = AxesLimits(city, landmarks, aspect=1.0)
    assert np.ptp(limits.x) == pytest.approx(6 * city.sensor.max_range)
    first = limits.x, limits.y
    edge = np.ptp(limits.x) / 4
    for far, changes in ((0.999, False), (-0.999, False), (1.001, True)):
        assert limits.follow(snapshot((far * edge, 0.0, 0.0))) == changes
    assert np.mean(limits.x) == pytest.approx(1.001 * edge)
    assert limits.follow(snapshot((9.0, -2 * edge, 0.0)))
    assert (np.mean(limits.x), np.mean(limits.y)) == pytest.approx((9, -2 * edge))
    assert np.ptp(limits.x) == pytest.approx(6 * city.sensor.max_range)
    assert limits.follow(snapshot((0.0, 0.0, 0.0), step=0))
    assert (limits.x, limits.y) == first


def test_clutter_is_marked_apart_from_readings():
    hidden = {"identities": False, "clutter": 1.0, "max_clutter": 5}
    world = SIX.with_changes(sensor={"max_range": 9.0, **hidden})
    renderer = WorldRenderer(world, LANDMARKS, "rgb_array", size_px=200)
    clutter = np.array([False, True, False, False, True])
    renderer.render(snapshot(clutter=clutter))
    moving = moving_parts(renderer)
    for marks, places in (
        (moving.clutter, LANDMARKS[clutter]),
        (moving.readings, LANDMARKS[~clutter]),
    ):
        np.testing.assert_allclose(np.transpose(marks.get_data()), places)
    labels = [t.get_text() for t in figure_of(renderer).legends[0].get_texts()]
    assert "clutter" in labels


def test_a_frame_looks_as_recorded():
    sensor = {"max_range": 9.0, "field_of_view": 2.0, "occlusion": True}
    world = SIX.with_changes(walls=((3.0, -9.0, 3.0, 9.0),), sensor=sensor)
    renderer = WorldRenderer(world, LANDMARKS, "rgb_array", size_px=200)
    renderer.render(snapshot(belief=FixedBelief(), collision=True))
    check_looks(figure_of(renderer), "frame")


def test_the_legend_shows_beliefs_as_ellipses(renderer):
    renderer.render(snapshot(belief=FixedBelief()))
    legend = figure_of(renderer).legends[0]
    ellipses = [key for key in legend.legend_handles if isinstance(key, Ellipse)]
    colours = [to_hex(key.get_edgecolor()) for key in ellipses]
    assert colours == ["#0072b2", "#009e73"]
