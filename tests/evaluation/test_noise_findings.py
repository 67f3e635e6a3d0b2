"""The tests of a world's noise, against the same tests of scipy on the numbers."""

import numpy as np
import pytest
from far_origins import far_origins
from scipy import stats

from slamgym.evaluation.noise_findings import (
    CHANNELS,
    HEAVY_TAILS,
    MOMENTS,
    _growth,
    _size_beside_tails,
    _spread_of_variance,
    noise_findings,
    noise_sums,
    significant_findings,
)

RUNS = 3


def sums_of(channel, numbers, lever=4.0):
    """Sums of one channel's numbers, shape (runs, n), and of no other."""
    sums = np.zeros((len(numbers), 5, 9))
    powers = [(numbers**k).sum(axis=1) for k in range(5)]
    leverage = np.full(len(numbers), lever**2 * numbers.shape[1])
    pairs = np.full(len(numbers), numbers.shape[1] - 1)
    lagged = (numbers[:, 1:] * numbers[:, :-1]).sum(axis=1)
    sums[:, CHANNELS.index(channel)] = np.stack(
        [*powers, lever * powers[1], leverage, pairs, lagged], axis=1
    )
    return sums


def findings_of(channel, numbers):
    found = noise_findings(sums_of(channel, numbers))
    return {each.cause: each for each in found}


def draw(shape=(RUNS, 200), *, scale=1.0, shift=0.0, seed=3):
    return shift + scale * np.random.default_rng(seed).standard_normal(shape)


@pytest.mark.parametrize(("scale", "cause"), [(1.4, "too small"), (0.6, "too large")])
def test_the_size_has_the_p_value_of_the_chi_square_test(scale, cause):
    numbers = draw(scale=scale)
    n, variance = numbers.size, numbers.var(ddof=1)
    found = findings_of("bearing", numbers)[f"bearing noise {cause}"]
    law = stats.chi2(n - 1)
    tails = law.cdf((n - 1) * variance), law.sf((n - 1) * variance)
    assert found.p_value == pytest.approx(2 * min(tails), rel=1e-6, abs=0)
    assert found.impact == pytest.approx(abs(np.log(variance)))
    assert f"σβ is {np.sqrt(variance):.3g} times" in found.text


@pytest.mark.parametrize("share", [0.1, 0.07, 0.02, -0.02, -0.07, -0.1, 1.0])
def test_a_correlation_in_time_has_the_p_value_of_a_normal_score(share):
    numbers = draw((RUNS, 400))
    numbers[:, 1:] += share * numbers[:, :-1]
    if share == 1:  # nearly constant in time
        numbers[:] = np.linspace(0, 1, 400)
    numbers += 0.3
    found = findings_of("turn", numbers)["correlated noise"]
    products = numbers[:, 1:] * numbers[:, :-1]
    rho = (products.mean() - numbers.mean() ** 2) / numbers.var(ddof=1)
    p_value = 2 * stats.norm.sf(abs(rho) * np.sqrt(products.size))
    assert found.p_value == pytest.approx(p_value, rel=1e-6, abs=0)
    assert (found.matters, found.sign) == (abs(rho) >= 0.05, 0)
    most = min(rho, 0.99)
    assert found.impact == pytest.approx(abs(np.log((1 + most) / (1 - most))))
    assert f"successive errors of σα have a correlation of {rho:.2g}" in found.text


@pytest.mark.parametrize(("strength", "matters"), [(0.09, False), (0.11, True)])
def test_a_mean_matters_from_a_tenth_on(strength, matters):
    numbers = draw()
    numbers = (numbers - numbers.mean()) / numbers.std(ddof=1)
    numbers += np.sqrt(strength / 200)
    assert findings_of("turn", numbers)["odometry turn"].matters == matters
    for lever in (0.0, 0.01):  # a robot at rest shows no error of the scale
        causes = [f.cause for f in noise_findings(sums_of("along", numbers, lever))]
        assert ("odometry scale" in causes) == (lever > 0)
        assert len(causes) == 3 + (lever > 0)


@pytest.mark.parametrize(("variance", "matters"), [(1.04, False), (0.94, True)])
def test_a_twentieth_of_the_variance_matters(variance, matters):
    numbers = draw()
    numbers = (numbers - numbers.mean()) / numbers.std(ddof=1) * np.sqrt(variance)
    found = findings_of("sideways", numbers)
    size = next(each for cause, each in found.items() if cause.startswith("motion"))
    assert size.matters == matters


@pytest.mark.parametrize(
    ("channel", "shift", "cause", "words"),
    [
        ("along", 0.5, "odometry scale", "distances {:.2%} too short"),
        ("along", -0.5, "odometry scale", "distances {:.2%} too long"),
        ("turn", 0.5, "odometry turn", "turns {d:.2g}° per step too far to the right"),
        ("turn", -0.5, "odometry turn", "turns {d:.2g}° per step too far to the left"),
        ("bearing", 0.5, "bearing bias", "bearings are {d:.2g}° too large"),
        ("bearing", -0.5, "bearing bias", "bearings are {d:.2g}° too small"),
        ("range", 0.5, "range bias", "ranges are {:.2g} m too large"),
        ("range", -0.5, "range bias", "ranges are {:.2g} m too small"),
    ],
)
def test_a_mean_has_the_p_value_of_students_test_and_its_direction(
    channel, shift, cause, words
):
    numbers = draw(shift=shift)
    found = findings_of(channel, numbers)[cause]
    test = stats.ttest_1samp(numbers.ravel(), 0.0)
    assert found.p_value == pytest.approx(test.pvalue, rel=1e-6, abs=0)
    assert found.impact == pytest.approx(test.statistic**2 / RUNS / 3)
    bias = abs(numbers.mean()) / 4.0  # of the lever
    assert words.format(bias, d=np.degrees(bias)) in found.text
    assert found.matters


@pytest.mark.parametrize("scale", [0.6, 1.0, 1.5])
@pytest.mark.parametrize("count", [10, 100])
@pytest.mark.parametrize("law", [stats.uniform(-1.7, 3.4), stats.laplace(0, 0.7)])
def test_tails_have_the_p_value_of_anscombe_and_glynn(law, count, scale):
    numbers = 0.3 + scale * law.rvs((RUNS, count), random_state=4)
    found = findings_of("range", numbers)[HEAVY_TAILS]
    kurtosis = stats.kurtosis(numbers, axis=None, fisher=False)
    expected = stats.kurtosistest(numbers.ravel()).pvalue
    assert found.p_value == pytest.approx(expected, rel=1e-6, abs=0)
    explained = 1.0
    if kurtosis > 3:
        student = stats.t(4 + 6 / (kurtosis - 3))
        assert student.stats("k") == pytest.approx(kurtosis - 3)
        explained = student.var()
    by_size = np.log(np.clip(numbers.var(ddof=1), 1.0, explained))
    assert found.impact == pytest.approx(max(by_size, (kurtosis - 3) / 10))
    assert found.matters == (kurtosis >= 3.5)
    assert f"kurtosis of {kurtosis:.3g}" in found.text
    assert found.sign == 0


@pytest.mark.parametrize(
    ("factor", "size"), [(1.8, "too small"), (0.5, "too large"), (2.5, "too small")]
)
def test_the_size_of_noise_that_changes_at_half_time_comes_before_tails(factor, size):
    numbers = draw((40, 200), seed=6)
    numbers[:, :100] *= factor
    sums = sums_of("bearing", numbers)
    assert np.mean(numbers**4) / np.mean(numbers**2) ** 2 > 3.5
    causes = [f.cause for f in significant_findings(sums, 0.02)]
    assert causes == [f"bearing noise {size}", HEAVY_TAILS]


@pytest.mark.parametrize("degrees", [5, 8, 12])
def test_the_variance_of_student_noise_is_explained_by_its_tails(degrees):
    numbers = np.random.default_rng(7).standard_t(degrees, (40, 200))
    first, *_ = significant_findings(sums_of("bearing", numbers), 0.02)
    assert first.cause == HEAVY_TAILS


def test_thirty_numbers_are_enough_and_fewer_are_not():
    assert not findings_of("turn", draw((1, 29)))
    for count in (30, 31):  # with one pair less
        found = findings_of("turn", draw((1, count)))
        assert ("correlated noise" in found) == (count > 30)
    assert set(findings_of("turn", np.ones((1, 40)))) == {
        *("odometry turn", "motion noise too large")
    }


def test_noise_where_none_is_assumed_counts_in_units_of_a_millionth():
    odometry = np.zeros((1, 3, 2))
    poses = np.zeros((1, 3, 3))
    poses[0, 2] = 0.0, -0.003, 0.0  # after a step without noise
    drive = poses, np.ones((1, 2, 2)), odometry, np.ones((1, 3, 2, 2))
    seen = np.array([[[True, False], [False, True], [False, False]]])
    assumed = {"motion_std": (0.1, 0.0, 0.1), "measurement_std": (0.1, 0.1)}
    sums = noise_sums(*drive, seen, **assumed)
    assert sums[0, 1, 1] == pytest.approx(-3000.0)
    assert not sums[0, 3:, MOMENTS.index("pairs")].any()  # of one landmark
    with pytest.raises(ValueError, match="noise_in must be 'motion' or 'odometry'"):
        noise_sums(*drive, seen, **assumed, noise_in="wheels")


@far_origins
def test_rounding_of_coordinates_is_no_noise(far):
    """Neither world nor filter has noise along or sideways."""
    poses, rng = np.zeros((1, 50, 3)), np.random.default_rng(3)
    poses[0, :, 2] = rng.uniform(-np.pi, np.pi, 50).cumsum()
    odometry = np.column_stack([rng.uniform(0, 2, 50), poses[0, :, 2]])[None]
    odometry[0, 1:, 1] -= poses[0, :-1, 2]
    poses[0, 0, :2] = far
    for step in range(49):
        heading = poses[0, step, 2]
        ahead = np.array([np.cos(heading), np.sin(heading)])
        poses[0, step + 1, :2] = poses[0, step, :2] + odometry[0, step + 1, 0] * ahead
    sums = noise_sums(
        poses,
        np.zeros((1, 1, 2)),
        odometry,
        np.ones((1, 50, 1, 2)),
        np.zeros((1, 50, 1), dtype=bool),
        motion_std=(0.0, 0.0, 0.1),
        measurement_std=(0.1, 0.1),
    )
    assert not sums[0, :2].any()


def far_noise(factor, law="normal", runs=40, seed=4):
    """Sums of ranges whose noise has another size beyond the median distance."""
    rng = np.random.default_rng(seed)
    r = rng.uniform(1, 9, (runs, 200))
    drawn = rng.standard_normal(r.shape)
    if law == "t":
        drawn = rng.standard_t(5, r.shape) / np.sqrt(5 / 3)
    w = np.where(r > 5, factor, 1.0) * drawn
    sums = np.pad(sums_of("range", w), [(0, 0), (0, 0), (0, 3)])
    moments = r.sum(axis=1), (r**2).sum(axis=1), (r * w**2).sum(axis=1)
    sums[:, CHANNELS.index("range"), 9:] = np.stack(moments, axis=1)
    return sums


@pytest.mark.parametrize(("factor", "size"), [(1.6, "too small"), (0.6, "too large")])
def test_noise_of_another_size_far_away_is_no_heavy_tail(factor, size):
    first, *others = significant_findings(far_noise(factor), 0.02)
    assert first.cause == f"range noise {size}"
    assert f"σr is {factor:.1f}"[:7] in first.text
    assert "times at 2.7 m" in first.text
    assert others == []


def moments_of(r, squares):
    powers = {"distance": r, "distance²": r**2, "second": squares,
              "fourth": squares**2, "distance w²": r * squares}  # fmt: skip
    return {"count": 5000.0} | {name: each.sum() for name, each in powers.items()}


def test_noise_has_no_growth_if_all_distances_or_all_squares_are_equal():
    rng = np.random.default_rng(6)
    w = rng.standard_normal(5000)
    for r, is_none in (
        *((np.full(5000, 1e4), True), (rng.uniform(9990, 10010, 5000), False)),
        *((np.zeros(5000), True), (rng.uniform(1, 1.1, 5000), False)),
    ):
        assert (_growth("range", moments_of(r, w**2), 1.0) is None) == is_none
        assert _growth("range", moments_of(r, np.full(5000, 0.25)), 0.25) is None


@pytest.mark.parametrize(
    ("base", "growth"),
    [
        *((0.6, 0.12), (0.6, -0.04), (0.6, 0.1), (0.6, 0.01), (0.6, -0.02)),
        *((0.6, 0.005), (1.3, -0.05), (1.2, 0.05), (1.04, 0.0)),
    ],
)
def test_the_impact_of_a_growth_is_that_of_a_line_through_the_squares(base, growth):
    rng = np.random.default_rng(6)
    r, w = rng.uniform(1, 9, 5000), rng.standard_normal(5000)
    squares = (w * (base + growth * r)) ** 2
    found = moments_of(r, squares)
    ends = r.mean() + r.std() * np.array([-1, 1])
    along = np.polyval(np.polyfit(r, squares, 1), ends)
    expected = np.abs(np.log([*along, squares.mean()])).max()
    seen = _growth("range", found, squares.mean())
    assert seen.impact == pytest.approx(expected)
    rho = np.corrcoef(r, squares)[0, 1]
    p_value = 2 * stats.norm.sf(abs(rho) * np.sqrt(5000))
    assert seen.p_value == pytest.approx(p_value, rel=1e-6, abs=0)
    assert seen.matters == (abs(along[1] - along[0]) >= 0.2 * squares.mean())
    share = (along[1] - along[0]) / 2 / squares.mean()
    assert _spread_of_variance(found) == pytest.approx(share**2)
    sides = np.sign(along - 1)
    assert seen.sign == (sides[0] if sides[0] == sides[1] else 0)
    size = "too small" if along.max() > 1.05 else "too large"
    assert seen.cause == f"range noise {size}"
    near, far = np.sqrt(along)
    assert seen.text == (
        f"σr is {far:.3g} times what it assumes at distances of {ends[1]:.2g} m, "
        f"and {near:.3g} times at {ends[0]:.2g} m"
    )


@pytest.mark.parametrize("kurtosis", [3.6, 6.0])
@pytest.mark.parametrize("variance", [0.5, 1.05, 1.4, 2.5])
def test_tails_explain_a_size_up_to_the_variance_of_student_noise(variance, kurtosis):
    student = stats.t(4 + 6 / (kurtosis - 3)).var()
    explained = np.clip(variance, 1.0, student)
    score = abs(variance - explained) / (variance * np.sqrt((kurtosis - 1) / 500))
    found = _size_beside_tails("turn", 500.0, variance, kurtosis)
    assert found.p_value == pytest.approx(2 * stats.norm.sf(score), rel=1e-9)
    assert found.impact == pytest.approx(abs(np.log(variance / explained)))
    assert found.matters == (abs(variance / explained - 1) >= 0.2)
    size = "small" if variance > 1 else "large"
    assert found.cause == f"motion noise too {size}"
    assert (found.sign, found.at_most) == (np.sign(variance - 1), max(variance, 1))


def test_heavy_tails_are_named_even_if_the_noise_grows_with_the_distance():
    causes = [f.cause for f in significant_findings(far_noise(1.6, "t"), 0.02)]
    assert set(causes) == {"range noise too small", HEAVY_TAILS}


def test_noise_of_one_size_does_not_depend_on_the_distance():
    found = [significant_findings(far_noise(1.0, seed=s), 0.02) for s in range(20)]
    assert found == [[]] * 20
    heavy = significant_findings(far_noise(1.0, "t"), 0.02)
    assert [f.cause for f in heavy] == [HEAVY_TAILS]
