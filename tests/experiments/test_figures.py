import functools
import itertools
from dataclasses import replace

import forked
import numpy as np
import pytest
from drawn import check_looks
from matplotlib.collections import EllipseCollection, LineCollection
from matplotlib.patches import Polygon
from matplotlib.text import Text
from PIL import Image
from run_traces import make_trace
from scipy.stats import chi2

from slamgym.experiments.figures import (
    comparison_figure,
    covariance_figure,
    errors_figure,
    map_figure,
    map_sequence,
    noise_study_figure,
    save_figure,
    truth_figure,
)
from slamgym.experiments.figures.accuracy import (
    correlations,
    entries,
    nis_band,
    row_labels,
)
from slamgym.experiments.figures.maps import (
    FIRST,
    LATER,
    PREDICTED,
    UPDATED,
    box_around,
    map_limits,
    pose_stride,
    shared_limits,
)
from slamgym.experiments.figures.style import draw_file, lay_out, new_figure


def noise_study(trace):
    names = [f"σ{name} {by}" for name in "xyαβr" for by in ("× 10", "÷ 10")]
    return noise_study_figure([(name, trace) for name in ("unchanged", *names)])


@pytest.mark.parametrize("suffix", ["svg", ".pdf"])
def test_a_figure_holds_no_date(tmp_path, suffix):
    draw_file(errors_figure(make_trace()), tmp_path / "figure", suffix)
    written = (tmp_path / "figure").read_bytes()
    assert b"<dc:date>" not in written
    assert b"/CreationDate" not in written


@functools.cache
def typical(figure_of):
    """Draw the figure of a typical run, once for all tests that only read it."""
    return figure_of(make_trace())


def comparison(trace):
    return comparison_figure([trace] * 3, walls=WALLS)


WALLS = ((-30.0, 0.0, 30.0, 0.0), (30.0, 0.0, 30.0, 5.0))
FIGURES = (map_figure, truth_figure, covariance_figure, errors_figure)
FIGURES += (noise_study, comparison)


def ellipses_of(figure, kind):
    (shown,) = (
        artist
        for artist in figure.axes[0].collections
        if isinstance(artist, EllipseCollection) and artist.get_label() == kind.label
    )
    return shown


def line_of(axes, label):
    (line,) = (line for line in axes.lines if line.get_label() == label)
    return line


def pixels_of(figure):
    figure.canvas.draw()
    return np.asarray(figure.canvas.buffer_rgba())[..., :3].copy()


# ---- every figure


def drawn_texts(figure, monkeypatch):
    """Boxes [pixels] of all texts that reach the canvas."""
    drawn, draw = {}, Text.draw

    def note(text, renderer):
        if text.get_visible() and text.get_text().strip():
            drawn[text] = None
        draw(text, renderer)

    monkeypatch.setattr(Text, "draw", note)
    figure.canvas.draw()
    return [(text.get_text(), text.get_window_extent()) for text in drawn]


@pytest.mark.parametrize("figure_of", FIGURES)
def test_figures_look_as_recorded(figure_of):
    check_looks(figure_of(make_trace()), figure_of.__name__)


@pytest.mark.parametrize("figure_of", FIGURES[:4])
def test_figures_of_large_maps_look_as_recorded(figure_of):
    trace = make_trace(320, 90, nis=np.full(321, 300.0))
    check_looks(figure_of(trace), f"{figure_of.__name__}_large")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("figure_of", "steps", "count"),
    [
        *((each, 12, 6) for each in FIGURES),
        *((each, 200, 200) for each in FIGURES if each is not noise_study),
    ],
)
def test_texts_neither_overlap_nor_leave_the_figure(
    figure_of, steps, count, monkeypatch
):
    figure = figure_of(make_trace(steps, count))
    texts = drawn_texts(figure, monkeypatch)
    assert len(texts) > 10
    for text, box in texts:
        assert min(box.x0, box.y0) >= 0, text
        assert box.x1 <= figure.bbox.x1, text
        assert box.y1 <= figure.bbox.y1, text
    for (one, a), (other, b) in itertools.combinations(texts, 2):
        overlap = min(a.x1 - b.x0, b.x1 - a.x0, a.y1 - b.y0, b.y1 - a.y0)
        assert overlap <= 1, f"{one!r} overlaps {other!r}"


def test_errors_and_time_have_units():
    axes = typical(errors_figure).axes
    labels = [a.get_ylabel() for a in axes]
    assert labels == ["x error [m]", "y error [m]", "θ error [rad]", "NIS"]
    assert axes[-1].get_xlabel() == "time [s]"
    counted = errors_figure(make_trace(time_unit="steps")).axes[-1]
    assert counted.get_xlabel() == "time [steps]"


@pytest.mark.slow
def test_figures_are_made_without_pyplot():
    code = "import slamgym.experiments.figures as figures, sys; figures.map_figure; "
    code += "print(*sys.modules)"
    modules = forked.run(code).stdout.split()
    assert "matplotlib.figure" in modules
    assert "matplotlib.pyplot" not in modules


@pytest.mark.parametrize("figure_of", [each for each in FIGURES if each != noise_study])
def test_run_that_never_saw_a_landmark_is_drawn(figure_of):
    figure = figure_of(make_trace(count=0))
    assert "nan" not in " ".join(text.get_text() for text in figure.findobj(Text))


# ---- the map


def test_the_four_kinds_of_ellipses_have_their_classic_colours():
    figure = typical(map_figure)
    magenta, blue, red, green = (1, 0, 1), (0, 0, 1), (1, 0, 0), (0, 1, 0)
    assert [
        tuple(np.round(ellipses_of(figure, kind).get_edgecolor()[0, :3]))
        for kind in (PREDICTED, UPDATED, FIRST, LATER)
    ] == [magenta, blue, red, green]


@pytest.mark.parametrize("step", [0, 1, 12])
def test_map_ellipses_are_three_sigma_of_their_covariances(step):
    trace = make_trace()
    seen = trace.first_steps() <= step
    steps = slice(0, step + 1)
    expected = {
        PREDICTED: (trace.predicted_poses, trace.predicted_pose_covariances, steps),
        UPDATED: (trace.poses, trace.pose_covariances, steps),
        FIRST: (trace.first_landmarks, trace.first_landmark_covariances, seen),
        LATER: (trace.map_at(step).means, trace.map_at(step).covariances, slice(None)),
    }
    figure = map_figure(trace, step)
    for kind, (means, blocks, rows) in expected.items():
        shown = ellipses_of(figure, kind)
        np.testing.assert_array_equal(shown.get_offsets(), means[rows, :2])
        axes = np.stack([shown.get_heights(), shown.get_widths()], axis=1)
        roots = np.sqrt(np.linalg.eigvalsh(blocks[rows, :2, :2]))
        np.testing.assert_allclose(axes, 6 * roots)


def test_path_ends_at_the_step():
    trace = make_trace()
    path = line_of(map_figure(trace, 4).axes[0], "estimated path")
    np.testing.assert_array_equal(path.get_xydata(), trace.poses[:5, :2])


def test_true_landmarks_are_crosses_and_absent_when_unknown():
    trace = make_trace()
    crosses = line_of(map_figure(trace).axes[0], "true landmark")
    assert crosses.get_marker() == "+"
    np.testing.assert_array_equal(crosses.get_xydata(), trace.true_landmarks)
    figure = map_figure(make_trace(true_landmarks=None))
    names = [text.get_text() for text in figure.legends[0].get_texts()]
    assert "true landmark" not in names
    assert UPDATED.label in names


def test_long_runs_draw_fewer_poses_and_say_so():
    figure = map_figure(make_trace(steps=600))
    assert 40 <= len(ellipses_of(figure, UPDATED).get_widths()) <= 61
    assert any("1 pose in 11 drawn" in text.get_text() for text in figure.axes[0].texts)


def test_a_long_run_draws_fewer_poses_where_their_ellipses_are_large():
    trace = make_trace(steps=299)
    large = replace(trace, pose_covariances=400 * trace.pose_covariances)
    few, many = (
        len(ellipses_of(map_figure(t), UPDATED).get_widths()) for t in (large, trace)
    )
    assert 12 <= few < many / 2


def test_a_long_run_may_have_ellipses_without_an_area():
    trace = make_trace(steps=299)
    flat = np.ones((3, 3)) - 1e-9 * np.eye(3)  # its determinant is below 0
    covariances = np.broadcast_to(flat, trace.pose_covariances.shape)
    assert pose_stride(replace(trace, pose_covariances=covariances)) == 5
    equal = np.broadcast_to(np.diag([1.0, 0.25, 0.1]), (300, 3, 3))  # √|P| is ½
    sized = replace(trace, pose_covariances=equal)
    drawn = 0.35 * np.prod(np.ptp(map_limits(sized), axis=0)) / (4.5 * np.pi)
    assert 12 < drawn < 60
    assert pose_stride(sized) == np.ceil(300 / int(drawn))


def test_the_robot_is_as_large_in_a_wide_map_as_in_a_high_one():
    sizes = []
    for scale in (1, 5), (5, 1):
        axes = map_figure(make_trace(poses=make_trace().poses * [*scale, 1])).axes[0]
        (robot,) = (patch for patch in axes.patches if isinstance(patch, Polygon))
        side = max(np.ptp(axes.get_xlim()), np.ptp(axes.get_ylim()))
        sizes.append(np.linalg.norm(np.ptp(robot.get_xy(), axis=0)) / side)
    assert sizes[0] == pytest.approx(sizes[1], rel=0.3)


@pytest.mark.parametrize("draw", [map_figure, truth_figure])
def test_true_landmarks_outside_the_map_are_drawn_too(draw):
    known = make_trace().true_landmarks
    everywhere = np.concatenate([known, [[40.0, -30.0]]])
    (axes, *_) = draw(make_trace(world_landmarks=everywhere)).axes
    crosses = line_of(axes, "true landmark").get_xydata()
    np.testing.assert_array_equal(crosses, everywhere)
    low, high = np.transpose([axes.get_xlim(), axes.get_ylim()])
    assert ((low < everywhere) & (everywhere < high)).all()


def test_view_is_the_same_at_every_step_and_holds_the_whole_run():
    trace = make_trace()
    first, last = map_figure(trace, 0).axes[0], typical(map_figure).axes[0]
    limits = first.get_xlim(), first.get_ylim()
    assert limits == (last.get_xlim(), last.get_ylim())
    low, high = np.transpose(limits)
    points = np.concatenate([trace.poses[:, :2], trace.landmarks, trace.true_landmarks])
    assert ((low < points) & (points < high)).all()


def test_shared_limits_exceed_the_first_box_by_at_most_half_its_size():
    boxes = [[[0, 0], [4, 2]], [[-1, -9], [3, 1]], [[1, 1], [9, 3.5]]]
    np.testing.assert_array_equal(shared_limits(boxes), [[-1, -2], [6, 3.5]])


def test_a_box_holds_points_and_the_near_parts_of_ellipses():
    points = np.array([[0.0, 1], [6, 2], [np.nan, np.nan], [3, 4]])
    covariances = np.array([np.diag([0.25, 0.04]), np.diag([9.0, 9])])
    means = np.array([[0.5, 3.8], [5.0, 2.0]])
    size = np.array([10, 7]) + 0.06 * 6  # a third of the width 6 beyond the points
    expected = np.array([[3.0, 2.5] - size / 2, [3.0, 2.5] + size / 2])
    np.testing.assert_allclose(box_around(points, means, covariances), expected)
    small = box_around(points, means[:1], covariances[:1])
    width, height = 7.0, 0.55 * 7  # x from -1 to 6; y from 1 to 4.4 would be too low
    middle = np.array([2.5, 2.7])
    half = (np.array([width, height]) + 0.06 * 6) / 2
    np.testing.assert_allclose(small, [middle - half, middle + half])


@pytest.mark.parametrize("step", [-1, 13])
def test_step_beyond_the_run_is_refused(step):
    with pytest.raises(ValueError, match=rf"step must be in 0 … 12, got {step}"):
        map_figure(make_trace(), step)


def test_map_before_any_landmark_is_drawn():
    nothing = (np.empty(0, int), np.empty((0, 2)), np.empty((0, 2, 2)))
    trace = make_trace()
    history = (nothing, *trace.landmark_history[1:])
    figure = map_figure(make_trace(landmark_history=history), 0)
    assert len(ellipses_of(figure, LATER).get_widths()) == 0
    assert len(ellipses_of(figure, FIRST).get_widths()) == 0


@pytest.mark.slow
def test_sequence_saves_the_map_of_every_step(tmp_path):
    trace = make_trace(steps=2)
    files = map_sequence(trace, tmp_path / "maps", dpi=100)
    assert [file.name for file in files] == [f"step_00{k}.png" for k in range(3)]
    assert sorted((tmp_path / "maps").iterdir()) == files
    for step in (0, 2):
        saved = np.asarray(Image.open(files[step]))
        expected = pixels_of(map_figure(trace, step))
        assert saved.shape == expected.shape
        assert np.mean((saved != expected).any(axis=-1)) < 0.02
        assert np.abs(saved.astype(int) - expected).mean() < 0.5


# ---- ground truth


def test_error_lines_join_estimates_and_truth():
    trace = make_trace()
    lines = [
        np.array(artist.get_segments())
        for artist in truth_figure(trace).axes[0].collections
        if isinstance(artist, LineCollection)
    ]
    path, landmarks = sorted(lines, key=len, reverse=True)
    np.testing.assert_array_equal(path[:, 0], trace.poses[:, :2])
    np.testing.assert_array_equal(path[:, 1], trace.true_poses[:, :2])
    np.testing.assert_array_equal(landmarks[:, 0], trace.landmarks)
    np.testing.assert_array_equal(landmarks[:, 1], trace.true_landmarks)


def test_landmarks_stand_in_the_order_of_their_ids():
    trace = make_trace()
    order = np.arange(len(trace.landmark_ids))[::-1]
    turned = replace(trace, landmark_ids=trace.landmark_ids[order])
    panels = truth_figure(trace).axes[1:], truth_figure(turned).axes[1:]
    for shown, other in zip(*panels, strict=True):  # in metres, and in deviations
        distances = [axes.lines[0].get_xdata() for axes in (shown, other)]
        np.testing.assert_array_equal(distances[0], distances[1][order])
        assert shown.get_xlim()[1] > distances[0].max()
    names = [[t.get_text() for t in axes.get_yticklabels()] for axes, _ in panels]
    assert names[0] == names[1] == [f"l{i}" for i in sorted(trace.landmark_ids)]


def test_distances_are_euclidean_and_mahalanobis():
    trace = make_trace()
    _, metres, deviations = truth_figure(trace).axes
    error = trace.landmarks - trace.true_landmarks
    np.testing.assert_allclose(
        metres.lines[0].get_xdata(), np.hypot(error[:, 0], error[:, 1])
    )
    inverse = np.linalg.inv(trace.landmark_covariances)
    np.testing.assert_allclose(
        deviations.lines[0].get_xdata(),
        np.sqrt(np.einsum("ni,nij,nj->n", error, inverse, error)),
    )
    sure = replace(trace, final_covariance=1e-3 * trace.final_covariance)
    axes = truth_figure(sure).axes[2]
    assert axes.get_xlim()[1] > axes.lines[0].get_xdata().max() > 3


def test_unknown_truth_is_left_out():
    trace = make_trace()
    poses, landmarks = trace.true_poses.copy(), trace.true_landmarks.copy()
    poses[3:], landmarks[2:], landmarks[3, 0] = np.nan, np.nan, 1.0
    partly = truth_figure(make_trace(true_poses=poses, true_landmarks=landmarks))
    assert len(partly.axes[1].lines[0].get_xdata()) == 2
    assert "nan" not in " ".join(text.get_text() for text in partly.findobj(Text))
    assert len(truth_figure(make_trace(true_landmarks=None)).axes) == 1
    assert len(truth_figure(make_trace(true_poses=None)).axes) == 3


def test_truth_figure_without_any_truth_is_refused():
    unknown = np.full((6, 2), np.nan)
    with pytest.raises(ValueError, match="true poses or true landmarks, got neither"):
        truth_figure(make_trace(true_poses=None, true_landmarks=unknown))


def test_the_names_of_many_landmarks_beside_a_low_map_do_not_overlap():
    figure = truth_figure(make_trace(12, 90), walls=WALLS)
    figure.draw_without_rendering()
    labels = [label for label in figure.axes[1].get_yticklabels() if label.get_text()]
    boxes = [label.get_window_extent() for label in labels]
    assert 10 < len(boxes) < 40
    for above, below in itertools.pairwise(sorted(boxes, key=lambda box: -box.y0)):
        assert above.y0 >= below.y1 - 1


@pytest.mark.parametrize("figure_of", [map_figure, truth_figure])
def test_a_long_name_of_a_filter_leaves_the_map_its_width(figure_of):
    widths = []
    for name in ("invariant", 'invariant[management={association="nearest"}]' * 2):
        figure = figure_of(make_trace(estimator=name))
        lay_out(figure, 100)
        widths.append(figure.axes[0].get_window_extent().width)
    assert widths[1] == pytest.approx(widths[0], rel=0.02)


@pytest.mark.parametrize("figure_of", [map_figure, truth_figure])
def test_walls_are_drawn_within_the_limits(figure_of):
    figure = figure_of(make_trace(), walls=WALLS)
    axes = figure.axes[0]
    (walls,) = (c for c in axes.collections if c.get_label() == "wall")
    np.testing.assert_array_equal(
        np.reshape(walls.get_segments(), (-1, 4)), np.array(WALLS)
    )
    assert axes.get_xlim()[0] < -30 < 30 < axes.get_xlim()[1]
    assert "wall" in [text.get_text() for text in figure.legends[0].get_texts()]


# ---- several filters


def test_filters_are_compared_on_the_same_area_with_landmarks_inside_3_sigma():
    honest = make_trace(count=4)
    overconfident = make_trace(
        count=4, estimator="certain", final_covariance=1e-9 * honest.final_covariance
    )
    figure = comparison_figure([honest, overconfident])
    left, right = figure.axes
    assert left.get_xlim() == right.get_xlim()
    assert left.get_ylim() == right.get_ylim()
    assert right.get_title(loc="left") == "certain"
    texts = [text.get_text() for axes in figure.axes for text in axes.texts]
    error = honest.landmarks - honest.true_landmarks
    inverse = np.linalg.inv(honest.landmark_covariances)
    inside = np.sum(np.einsum("ni,nij,nj->n", error, inverse, error) <= 9)
    assert inside > 0
    assert texts[0].startswith(f"{inside} of 4 landmarks inside 3σ")
    assert texts[1].startswith("0 of 4 landmarks inside 3σ")
    with pytest.raises(ValueError, match="two filters or more, got 1"):
        comparison_figure([honest])


# ---- covariance


def test_correlations_are_scaled_covariances():
    P = np.array([[4.0, -1.0, 0.0], [-1.0, 1.0, 0.0], [0.0, 0.0, 0.0]])
    expected = [[1.0, -0.5, np.nan], [-0.5, 1.0, np.nan], [np.nan] * 3]
    np.testing.assert_array_equal(correlations(P), expected)


def test_heat_maps_show_first_and_final_correlations_on_one_scale():
    trace = make_trace()
    before, after, bar = covariance_figure(trace).axes
    covariances = trace.first_covariance, trace.final_covariance
    for axes, covariance in zip((before, after), covariances, strict=True):
        image = axes.images[0]
        np.testing.assert_allclose(image.get_array(), correlations(covariance))
        assert image.get_clim() == (-1, 1)
    assert bar.get_ylabel() == "correlation"


def test_rows_are_named_after_the_state_and_carry_their_deviation():
    trace = make_trace()
    before, after, _ = covariance_figure(trace).axes
    names = [label.get_text() for label in after.get_yticklabels()]
    assert names[:6] == ["x", "y", "θ", "l10x", "l10y", "l11x"]
    assert names[-1] == "l15y"
    first = [label.get_text() for label in before.get_yticklabels()]
    assert first[3:] == ["l10x", "l10y", "l13x", "l13y"]  # those of the first scan
    sigma = np.sqrt(trace.final_covariance[2, 2])
    assert f"σ = {sigma:.2g} rad" in [text.get_text() for text in after.texts]


def test_rows_of_large_maps_are_named_thinly():
    assert row_labels(np.arange(13)) == (list(range(29)), entries(np.arange(13)))
    for count in 14, 200:
        rows, names = row_labels(10 + np.arange(count))
        assert (rows[0], names[0]) == (1, "pose")
        assert 5 < len(names) < 20
        assert rows[1:] == [3.5 + 2 * (int(name[1:]) - 10) for name in names[1:]]


@pytest.mark.slow
def test_certain_rows_are_grey_not_white():
    certain = make_trace().first_covariance.copy()
    certain[:3], certain[:, :3] = 0, 0
    figure = covariance_figure(make_trace(first_covariance=certain))
    explained = [axes.texts[-1].get_text() for axes in figure.axes[:2]]
    assert [text.startswith("grey: known exactly") for text in explained] == [1, 0]
    image = figure.axes[0].images[0]
    assert np.ma.getmaskarray(image.get_array())[:3].all()
    assert image.axes.get_facecolor() != (1, 1, 1, 1)


# ---- consistency


def test_heading_errors_are_wrapped():
    trace = make_trace()
    turned = make_trace(poses=trace.poses + np.array([0.0, 0.0, 2 * np.pi]))
    lines = [line_of(errors_figure(each).axes[2], "error") for each in (trace, turned)]
    np.testing.assert_allclose(*(line.get_ydata() for line in lines), atol=1e-12)


def test_error_lines_lie_in_bands_of_three_sigma():
    trace = make_trace()
    trace.true_poses[:2] = np.nan  # such errors do not count
    for k, axes in enumerate(errors_figure(trace).axes[:3]):
        std = np.sqrt(trace.pose_covariances[:, k, k])
        error = line_of(axes, "error").get_ydata()
        np.testing.assert_allclose(error, (trace.poses - trace.true_poses)[:, k])
        vertices = axes.collections[0].get_paths()[0].vertices
        assert vertices[:, 1].max() == pytest.approx(3 * std.max())
        assert vertices[:, 1].min() == pytest.approx(-3 * std.max())
        share = np.mean((np.abs(error) <= 3 * std)[2:])
        assert f"{share:.0%}" in axes.get_title(loc="left")


def test_nis_band_holds_95_percent():
    lower, upper = nis_band(np.array([0, 1, 2, 6]))
    np.testing.assert_allclose(chi2.cdf(upper[1:], [1, 2, 6]), 0.975)
    np.testing.assert_allclose(chi2.cdf(lower[1:], [1, 2, 6]), 0.025)
    assert np.isnan([lower[0], upper[0]]).all()


def test_nis_outside_its_band_is_told_apart_and_idle_steps_are_left_out():
    nis = np.full(13, 5.0)
    nis[[0, 4, 7]] = [0.0, 0.01, 40.0]  # no update at step 0
    axes = errors_figure(make_trace(nis=nis)).axes[-1]
    np.testing.assert_array_equal(line_of(axes, "outside").get_xdata(), [2.0, 3.5])
    assert len(line_of(axes, "inside").get_xdata()) == 10
    assert axes.get_title(loc="left") == "NIS: 83% of the steps in the 95% band"
    low, high = axes.get_ylim()
    assert low < -0.02 * high  # the marker near 0 is whole


def test_without_true_poses_only_the_nis_is_drawn():
    for unknown in (None, np.full((13, 3), np.nan)):
        (axes,) = errors_figure(make_trace(true_poses=unknown)).axes
        assert axes.get_ylabel() == "NIS"


def test_nis_far_off_gets_a_logarithmic_axis():
    far = np.where(np.arange(13) == 5, 1e5, 6.0)
    assert errors_figure(make_trace(nis=far)).axes[-1].get_yscale() == "log"
    axes = errors_figure(make_trace(nis=np.linspace(-0.001, 0.01, 13).clip(0))).axes[-1]
    assert axes.get_yscale() == "log"
    assert 0 < axes.get_ylim()[0] < 0.01 / 12
    assert typical(errors_figure).axes[-1].get_yscale() == "linear"


def test_run_without_any_update_has_an_empty_nis():
    axes = errors_figure(make_trace(nis_dof=np.zeros(13, int))).axes[-1]
    assert axes.get_title(loc="left") == "NIS: none was reported"


# ---- noise study


def test_noise_panels_share_one_view_and_come_in_reading_order():
    figure = typical(noise_study)
    shown = [axes for axes in figure.axes if axes.axison]
    titles = [axes.get_title(loc="left") for axes in shown]
    assert titles[:4] == ["unchanged", "σx × 10", "σx ÷ 10", "σy × 10"]
    assert len(shown) == 11
    assert len({(axes.get_xlim(), axes.get_ylim()) for axes in shown}) == 1
    x = {round(axes.get_position().x0, 3) for axes in shown}
    assert len(x) == 4


@pytest.mark.slow
@pytest.mark.parametrize("count", [2, 3, 4, 6])
def test_any_number_of_variations_is_laid_out(count):
    figure = noise_study_figure([(str(k), make_trace()) for k in range(count)])
    shown = [axes for axes in figure.axes if axes.axison]
    assert [axes.get_title(loc="left") for axes in shown] == list("012345"[:count])
    lowest = {}
    for axes in shown:
        lowest[axes.get_subplotspec().colspan.start] = axes.get_xlabel()
    columns = {0, *range(2, 4)[: count - 1], *range(4)[: count - 3 if count > 3 else 0]}
    assert lowest == dict.fromkeys(columns, "x [m]")


def test_noise_study_needs_a_variation():
    with pytest.raises(ValueError, match="a reference and a variation, got 1"):
        noise_study_figure([("unchanged", make_trace())])


# ---- files


def small_figure():
    figure = new_figure(2.0, 1.5)
    figure.add_subplot().plot([0, 1])
    return figure


@pytest.mark.slow
@pytest.mark.parametrize("suffix", ["png", "pdf", "svg"])
def test_saved_figures_are_complete_and_equal(tmp_path, suffix):
    for name in ("one", "other"):
        save_figure(small_figure(), tmp_path / f"{name}.{suffix}", dpi=50)
    one, other = sorted(tmp_path.iterdir())
    assert one.stat().st_size > 1000
    assert one.read_bytes() == other.read_bytes()


def test_failed_save_leaves_the_former_file_and_nothing_else(tmp_path, monkeypatch):
    path = tmp_path / "errors.png"
    path.write_text("former")
    figure = small_figure()

    def half_written(partial, **_):
        partial.write_text("half")
        raise OSError("disk full")

    monkeypatch.setattr(figure, "savefig", half_written)
    with pytest.raises(OSError, match="disk full"):
        save_figure(figure, path)
    assert path.read_text() == "former"
    assert list(tmp_path.iterdir()) == [path]


def test_unknown_format_is_refused(tmp_path):
    with pytest.raises(ValueError, match=r"path must end in one of .*\.png.*'.*\.doc'"):
        save_figure(small_figure(), tmp_path / "errors.doc")
    assert list(tmp_path.iterdir()) == []
