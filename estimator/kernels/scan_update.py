"""Update of one belief by one scan, compiled: screen, correct, map new landmarks.

`update_belief` is the whole update.  Below it are its parts, down to the Kalman gain:
`absorb` conditions the covariance on many readings at once, and `compose` moves the
state.  The gain K = Aᵀ L⁻¹ itself is never formed.  At the end are the `Rules` that
distinguish one filter from another, and the arrays that a kernel works in.

``system`` holds two rows for each reading, from the row FIRST of the workspace on.
`Workspace` and the constants above it describe them.  The covariance has room for whole
vector registers (`BeliefArrays`), and the rows are up to 4 entries longer.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ...argument_checks import aligned_zeros
from ...arrays import LARGEST, Array, IntArray
from ...jit import fma, njit_apart, njit_inlined, njit_internal
from ..models.bearing_range import (
    difference_jit,
    expected_reading_jit,
    placed_jit,
    places_at_once_jit,
    pose_slopes_jit,
    read_distance_jit,
    reading_variances_jit,
)
from ..models.relative_geometry import variance_from_robot
from ..models.rigid_motion import ErrorFrame, turn_coefficients_jit

# Status of an update; from 0 on it is the number of the reading that failed.
DONE, NOT_USABLE = -1, -2


@njit_internal
def update_belief(
    belief: tuple[Array, Array, Array],
    size: int,
    readings: Array,
    count: int,
    ledger: IntArray,
    workspace: tuple[Array, Array],
    rule_values: Array,
) -> tuple[int, int, float]:
    """Update one belief with one scan, in place.

    Parameters
    ----------
    belief : BeliefArrays
        With room for the landmarks to add.
    size : int
        Length of the state.
    readings : ndarray, shape (at least count, 2)
        Rows (β, r) [rad, m].
    ledger
        Integers (LEDGER_HEIGHT, readings), whose row SLOT holds the place of each
        reading's landmark in the map.  On return its other rows are filled, and SLOT
        holds the places of added landmarks, too.
    workspace : Workspace
        On return it holds the record of the scan.
    rule_values
        The filter's rules, as :func:`as_rules` reads them.

    Returns
    -------
    status : int
        DONE, NOT_USABLE, or which reading, of those in use, has an innovation
        covariance that is not positive definite.  Unless DONE, nothing has changed.
    used : int
        Number of readings of mapped landmarks in use.
    nis : float
        νᵀ S⁻¹ ν over them.
    """
    status, used, nis = update_lower_half(
        belief, size, readings, count, ledger, workspace, rule_values
    )
    if size > LARGE and used > 0:
        mirror(belief[1], size)
    return status, used, nis


@njit_internal
def update_lower_half(
    arrays: tuple[Array, Array, Array],
    size: int,
    readings: Array,
    count: int,
    ledger: IntArray,
    work_arrays: tuple[Array, Array],
    rule_values: Array,
) -> tuple[int, int, float]:
    """Update one belief as :func:`update_belief` does, but leave a large P incomplete.

    If the state is longer than LARGE, only the lower half of P and the rows of the pose
    are right on return.  These, and the rows of the landmarks in the scan, must be
    right before.  Copying a large half takes as long as computing it.
    """
    belief, workspace = BeliefArrays(*arrays), Workspace(*work_arrays)
    rows, rules = workspace.rows, as_rules(rule_values)
    used = screen(belief, readings, count, rules, rules.gate, rows, ledger)
    if used < 0:
        return used, 0, 0.0
    failed = correct(belief, size, ledger, rules, workspace, used)
    if failed >= 0:
        return failed // 2, used, 0.0
    add_landmarks(belief, size, readings, count, rules, ledger)
    return DONE, used, squared_norm(rows, used)


@njit_inlined
def squared_norm(rows: Array, used: int) -> float:
    """Return the NIS of the readings in use, linearised at the prior."""
    nis = 0.0
    for row in range(FIRST, FIRST + 2 * used):
        nis += rows[row, WHITE] * rows[row, WHITE]
    return nis


@njit_inlined
def add_landmarks(
    belief: BeliefArrays,
    size: int,
    readings: Array,
    count: int,
    rules: Rules,
    ledger: IntArray,
) -> None:
    """Append the landmarks seen first, and write their slots to the ledger."""
    for k in range(count):
        if ledger[OUTCOME, k] == ADDED:
            add_landmark(belief, size, readings[k, 0], readings[k, 1], rules)
            ledger[SLOT, k] = (size - 3) // 2
            size += 2


@njit_inlined
def as_rules(values: Array) -> Rules:
    """Read rules from the array ``numpy.array(rules)``.

    Python passes one array faster than a tuple of thirteen numbers.
    """
    return Rules(
        int(values[0]),
        int(values[1]),
        int(values[2]),
        values[3] > 0,
        values[4] > 0,
        values[5],
        values[6],
        values[7],
        values[8],
        values[9],
        values[10],
        values[11] > 0,
        int(values[12]),
    )


# --------------------------------------------------------------------------------------
# Screening: minimum range, chi-square gate, nearness.


@njit_internal
def usable(value: float) -> bool:
    """Return whether a number is at most LARGEST, so that its square is finite."""
    return abs(value) <= LARGEST


@njit_internal
def screen(
    belief: BeliefArrays,
    readings: Array,
    count: int,
    rules: Rules,
    gate: float,
    rows: Array,
    ledger: IntArray,
) -> int:
    """Decide the outcome of every reading and collect those to use.

    The belief stays as it is.  Returns how many readings are in use, or NOT_USABLE.
    """
    for k in range(count):
        if not (usable(readings[k, 0]) and usable(readings[k, 1])):
            return NOT_USABLE
    mean, system, used = belief.mean, rows[FIRST:], 0
    for k in range(count):
        z0, z1 = readings[k, 0], readings[k, 1]
        distance = read_distance_jit(z0, z1)
        column = 3 + 2 * ledger[SLOT, k]
        new = ADDED if places_at_once_jit() else WAITING
        ledger[OUTCOME, k] = new if ledger[SLOT, k] < 0 else USED
        ledger[NEAR, k] = 0
        if distance < rules.min_range:
            ledger[OUTCOME, k] = SKIPPED
        if ledger[OUTCOME, k] != USED:
            continue
        dx, dy = mean[column] - mean[0], mean[column + 1] - mean[1]
        expected = np.sqrt(dx * dx + dy * dy)
        if expected < rules.min_range:
            ledger[OUTCOME, k] = SKIPPED
            continue
        row = 2 * used
        ledger[COLUMN, used] = column
        system[row, READING], system[row + 1, READING] = z0, z1
        # The range as read makes σr small just where its error is negative.
        at = distance if rules.noise_as_read else expected
        system[row, VARIANCE], system[row + 1, VARIANCE] = variances(rules, at)
        ledger[NEAR, k] = is_near(mean, belief.covariance, column)
        if gate < np.inf:
            linearise(mean, belief.reference, rules.linearisation, system, row, column)
            if not squared_innovation(belief.covariance, system, row, column) <= gate:
                ledger[OUTCOME, k] = GATED
                continue
        used += 1
    return used


@njit_internal
def variances(rules: Rules, distance: float) -> tuple[float, float]:
    """Return the two variances of a reading at that distance [m], above 0."""
    noise = rules.first_std, rules.second_std, rules.std_per_metre, rules.std_metres
    return reading_variances_jit(noise, distance)


@njit_internal
def own_covariance(
    P: Array, system: Array, row: int, c: int
) -> tuple[float, float, float]:
    """Return S of the reading in two rows: S_ββ, S_βr, S_rr."""
    h, h_below = system[row, JACOBIAN:], system[row + 1, JACOBIAN:]
    s00, s10, s11 = system[row, VARIANCE], 0.0, system[row + 1, VARIANCE]
    for i in range(5):
        at_i = i if i < 3 else c + i - 3
        for j in range(5):
            entry = P[at_i, j if j < 3 else c + j - 3]
            s00 += h[i] * entry * h[j]
            s10 += h_below[i] * entry * h[j]
            s11 += h_below[i] * entry * h_below[j]
    return s00, s10, s11


@njit_internal
def squared_innovation(covariance: Array, system: Array, row: int, c: int) -> float:
    """Return the NIS of one reading by itself, νᵀ S⁻¹ ν, for the gate."""
    s00, s10, s11 = own_covariance(covariance, system, row, c)
    n0, n1 = system[row, INNOVATION], system[row + 1, INNOVATION]
    return squared_ratio(n0, n1, s00, s10, s11)


@njit_inlined
def squared_ratio(n0: float, n1: float, s00: float, s10: float, s11: float) -> float:
    """Return νᵀ S⁻¹ ν of one reading."""
    weighted = n0 * n0 * s11 - 2 * n0 * n1 * s10 + n1 * n1 * s00
    return weighted / (s00 * s11 - s10 * s10)


@njit_internal
def is_near(mean: Array, covariance: Array, column: int) -> bool:
    """Return whether the robot is within 10 σ of a landmark: linearisation then fails.

    σ is the largest standard deviation of the landmark's place relative to the robot.
    """
    dx, dy = mean[column] - mean[0], mean[column + 1] - mean[1]
    spread = variance_from_robot(covariance, column, dx, dy)
    return bool(dx * dx + dy * dy < 100 * spread)


# --------------------------------------------------------------------------------------
# One correction: linearise, condition, compose; again where a reading asks for it.

# What asks for another linearisation, or for readings one by one.
FAR = 0.1  # a reading off its prediction, or a landmark moved, relative to its range
TURNED = 0.1  # heading [rad]

# Excess of νᵀ S⁻¹ ν at which an iterate is not believed: 99.9 % of χ²(2).
IMPLAUSIBLE = 13.8


@njit_inlined
def correct(
    belief: BeliefArrays,
    size: int,
    ledger: IntArray,
    rules: Rules,
    workspace: Workspace,
    used: int,
) -> int:
    """Condition the belief on the readings in use, or leave it as it was.

    Returns -1, or the row at which the innovation covariance is not positive definite.
    What such a row could spoil is copied first: where P changes before the last row is
    read.
    """
    if used == 0:
        return -1
    mean, covariance, rows = belief.mean, belief.covariance, workspace.rows
    system, prior, columns = rows[FIRST:], rows[MEAN_BEFORE], ledger[COLUMN]
    for j in range(size):
        prior[j] = mean[j]
    repeats = rules.iterations > 1 and not rules.adaptive
    for k in range(used):
        linearise(
            mean, belief.reference, rules.linearisation, system, 2 * k, columns[k]
        )
        repeats |= rules.adaptive and is_far_off(mean, system, 2 * k, columns[k])
    if repeats:
        failed = relinearise(belief, size, ledger, rules, rows, used)
    else:
        block = BLOCK if size <= LARGE else used  # few while P fits the caches
        if used > block:
            copy_covariance(covariance, workspace.before, size)
        failed = absorb(covariance, size, rows, columns, used, block)
        if failed < 0:
            compose(mean, prior, rows, size, rules.frame)
        elif used > block:
            copy_covariance(workspace.before, covariance, size)
    if failed >= 0:
        for j in range(size):
            mean[j] = prior[j]
        return failed
    if rules.frame == INVARIANT:
        transport(covariance, rows, size)
    restore_upper(covariance, size)
    return -1


@njit_internal
def copy_covariance(source: Array, target: Array, size: int) -> None:
    """Copy a covariance."""
    for i in range(size):
        for j in range(size):
            target[i, j] = source[i, j]


@njit_internal
def relinearise(
    belief: BeliefArrays,
    size: int,
    ledger: IntArray,
    rules: Rules,
    rows: Array,
    used: int,
) -> int:
    """Linearise again at each iterate, with the same prior (Bell and Cathey, 1993).

    Every iterate takes its rows of A from the prior P, and the last ones downdate it.
    In the invariant frame the heading column of H keeps the prior's geometry: with the
    exact Gauss-Newton column the filter would believe that it observes its heading.

    Adaptive rules stop when no landmark moves any more.  Where the heading turns, the
    joint iterates can diverge, and the readings are taken one by one.

    Returns -1, or the row at which the innovation covariance is not positive definite;
    P is then as before.
    """
    mean, columns = belief.mean, ledger[COLUMN]
    now, second, at = rows[FIRST:], second_system(rows), rows[ITERATE]
    for k in range(used):
        copy_reading(now, 2 * k, second, 2 * k)
    for iteration in range(rules.iterations):
        for j in range(size):
            at[j] = mean[j]
        if iteration > 0:
            now = second
            for k in range(used):
                linearise_again(at, belief, rules, rows, 2 * k, columns[k])
        begin_correction(size, rows, now, 2 * used)
        for k in range(used):
            if not whiten(belief.covariance, size, rows, now, 0, 2 * k, columns[k]):
                return 2 * k
        compose(mean, rows[MEAN_BEFORE], rows, size, rules.frame)
        if rules.adaptive:
            if abs(rows[CORRECTION, 2]) > TURNED:
                now = second
                failed = take_one_by_one(belief, size, ledger, rules, rows, used)
                if failed >= 0:
                    return failed
                break
            settled = True
            for k in range(used):
                settled &= not has_moved(at, mean, columns[k])
            if settled:
                break
    downdate(belief.covariance, size, now, 0, 2 * used)
    return -1


@njit_inlined
def second_system(rows: Array) -> Array:
    """Return the system of readings linearised again, where the rules iterate."""
    return rows[FIRST + (len(rows) - FIRST) // 2 :]


@njit_internal
def take_one_by_one(
    belief: BeliefArrays,
    size: int,
    ledger: IntArray,
    rules: Rules,
    rows: Array,
    used: int,
) -> int:
    """Correct the mean by one reading after the other, the farthest landmark first.

    Each is linearised at the mean that those before it leave, and again until its
    landmark no longer moves; once only where the iterates do not settle, or end where
    the reading is less plausible than at first.  P is constant in invariant
    coordinates, so that all rows of A come from the prior P, as in `relinearise`.

    Far landmarks are first because their bearings fix the heading, and depend least on
    the position.
    """
    mean, prior = belief.mean, rows[MEAN_BEFORE]
    system, again = rows[FIRST:], second_system(rows)
    columns, order = ledger[COLUMN], ledger[ORDER]
    sort_by_range(prior, columns, used, order)
    for j in range(size):
        mean[j] = prior[j]
    for k in range(used):
        row, read, c = 2 * k, 2 * order[k], columns[order[k]]
        copy_reading(system, read, again, row)
        begin_correction(size, rows, again, 2 * used)
        once, last = iterate_reading(
            belief, size, rules, rows, row, c, rules.iterations
        )
        if math.isnan(last):
            return int(read)
        if last > once + IMPLAUSIBLE:
            iterate_reading(belief, size, rules, rows, row, c, 1)
        retract(mean, mean, rows, size)
    return -1


@njit_internal
def iterate_reading(
    belief: BeliefArrays,
    size: int,
    rules: Rules,
    rows: Array,
    row: int,
    c: int,
    most: int,
) -> tuple[float, float]:
    """Linearise one reading at the mean, and again until its landmark is at rest.

    Returns νᵀ S⁻¹ ν of the first linearisation and of the last: inf where the landmark
    still moves after ``most``, nan where S is not positive definite.
    """
    mean, prior, at = belief.mean, rows[MEAN_BEFORE], rows[ITERATE]
    again, delta = second_system(rows), rows[CORRECTION]
    for i in range(2):
        at[i], at[c + i] = mean[i], mean[c + i]
    at[2], once = mean[2], np.inf
    for j in range(size):
        delta[j] = 0.0
    for iteration in range(most):
        linearise_again(at, belief, rules, rows, row, c)
        begin_correction(size, rows, again, row + 2)
        if not whiten(belief.covariance, size, rows, again, 0, row, c):
            return once, np.nan
        nis = again[row, WHITE] ** 2 + again[row + 1, WHITE] ** 2
        once = nis if iteration == 0 else once
        x, y = at[c] - at[0], at[c + 1] - at[1]
        turned = turn_coefficients_jit(delta[2])
        retract_point(at, mean, prior, delta, turned, 0)
        retract_point(at, mean, prior, delta, turned, c)
        at[2] = mean[2] + delta[2]
        if not is_displaced(x, y, at[c] - at[0], at[c + 1] - at[1]):
            return once, nis
    return once, np.inf


@njit_internal
def sort_by_range(mean: Array, columns: IntArray, used: int, order: IntArray) -> None:
    """Fill the order of the readings in use, that of the farthest landmark first."""
    for k in range(used):
        place = k
        while place > 0 and squared_range(mean, columns[k]) > squared_range(
            mean, columns[order[place - 1]]
        ):
            order[place] = order[place - 1]
            place -= 1
        order[place] = k


@njit_internal
def squared_range(mean: Array, c: int) -> float:
    """Return the squared distance of the robot to a landmark [m²]."""
    dx, dy = mean[c] - mean[0], mean[c + 1] - mean[1]
    return float(dx * dx + dy * dy)


@njit_internal
def is_far_off(mean: Array, system: Array, row: int, c: int) -> bool:
    """Whether a reading differs from its prediction by more than FAR of the range.

    A difference ν counts as the shift of the landmark by ν / ‖∂h/∂l‖.
    """
    least, far = FAR * FAR * squared_range(mean, c), False
    for i in range(row, row + 2):
        nu, x, y = system[i, INNOVATION], system[i, LANDMARK_X], system[i, LANDMARK_Y]
        far |= nu * nu > least * (x * x + y * y)
    return far


@njit_internal
def has_moved(before: Array, after: Array, c: int) -> bool:
    """Whether a landmark moves relative to the robot between two states."""
    return is_displaced(
        before[c] - before[0],
        before[c + 1] - before[1],
        after[c] - after[0],
        after[c + 1] - after[1],
    )


@njit_internal
def is_displaced(x: float, y: float, new_x: float, new_y: float) -> bool:
    """Whether a displacement from the robot changes by more than FAR of the range."""
    dx, dy = new_x - x, new_y - y
    return bool(dx * dx + dy * dy > FAR * FAR * (x * x + y * y))


@njit_internal
def copy_reading(source: Array, row: int, target: Array, to: int) -> None:
    """Copy the reading in ``row`` and the next, and its variances, to another row."""
    for i in range(2):
        target[to + i, READING] = source[row + i, READING]
        target[to + i, VARIANCE] = source[row + i, VARIANCE]


@njit_internal
def linearise_again(
    at: Array, belief: BeliefArrays, rules: Rules, rows: Array, row: int, c: int
) -> None:
    """Linearise the reading in ``row`` of the second system at an iterate.

    ν becomes z − h + H δ, the innovation seen from the state that δ corrects.
    """
    system, prior, delta = second_system(rows), rows[MEAN_BEFORE], rows[CORRECTION]
    linearise(at, belief.reference, rules.linearisation, system, row, c)
    if rules.adaptive and not rules.noise_as_read:
        distance = max(np.sqrt(squared_range(at, c)), rules.min_range)
        system[row, VARIANCE], system[row + 1, VARIANCE] = variances(rules, distance)
    dx, dy = prior[c] - prior[0], prior[c + 1] - prior[1]
    for i in range(row, row + 2):
        h = system[i, JACOBIAN : JACOBIAN + 5]
        if rules.frame == INVARIANT:
            h[2] = h[3] * dy - h[4] * dx
        system[i, INNOVATION] += times(system, i, c, delta)


# --------------------------------------------------------------------------------------
# Linearisation of one reading.
#
# For a reading of the landmark in columns c, c+1 of the state only five columns of H
# differ from zero: (x, y, θ, c, c+1).  A row of H is stored as these five entries.


@njit_internal
def linearise(
    mean: Array,
    reference: Array,
    linearisation: int,
    system: Array,
    row: int,
    column: int,
) -> None:
    """Fill H and ν of the reading in ``row`` and the next.

    At the estimate they are those of :func:`..models.bearing_range.predict_measurement`
    for a sensor of bearing and range.
    """
    H = system[row : row + 2, JACOBIAN : JACOBIAN + 5]
    z, nu = system[row : row + 2, READING], system[row : row + 2, INNOVATION]
    dx, dy = mean[column] - mean[0], mean[column + 1] - mean[1]
    e0, e1 = expected_reading_jit(dx, dy, mean[2])
    nu[0], nu[1] = difference_jit(z[0], z[1], e0, e1)
    heading = mean[2]
    if linearisation in (AT_REFERENCE, AT_TRUTH):
        dx = reference[column] - reference[0]
        dy = reference[column + 1] - reference[1]
        heading = reference[2]
    fill_slopes(dx, dy, heading, H)
    if linearisation == PROJECTED:
        _project(reference, column, H)


@njit_internal
def fill_slopes(dx: float, dy: float, heading: float, H: Array) -> None:
    """Fill H (2, 5) of a reading of the landmark at (dx, dy) from the robot."""
    ax, ay, bx, by, a_turn, b_turn = pose_slopes_jit(dx, dy, heading)
    H[0, 0], H[0, 1], H[0, 2] = -ax, -ay, a_turn
    H[1, 0], H[1, 1], H[1, 2] = -bx, -by, b_turn
    H[0, 3], H[0, 4] = ax, ay
    H[1, 3], H[1, 4] = bx, by


@njit_internal
def _project(reference: Array, column: int, H: Array) -> None:
    """H ← H − (H w) wᵀ / wᵀw: blind to the rotation w of robot and landmark together.

    w is J δ of the reference points, spread about their midpoint: the part of a
    rotation about the origin that is orthogonal to both translations, to which H is
    blind anyway.
    """
    half_x = (reference[column] - reference[0]) / 2
    half_y = (reference[column + 1] - reference[1]) / 2
    squared = 1 + 2 * (half_x * half_x + half_y * half_y)
    for i in range(2):
        along_x, along_y = H[i, 0] - H[i, 3], H[i, 1] - H[i, 4]
        turned = along_x * half_y - along_y * half_x + H[i, 2]
        seen = turned / squared
        H[i, 0] -= seen * half_y
        H[i, 1] += seen * half_x
        H[i, 2] -= seen
        H[i, 3] += seen * half_y
        H[i, 4] -= seen * half_x


@njit_internal
def add_landmark(
    belief: BeliefArrays, size: int, z0: float, z1: float, rules: Rules
) -> None:
    """Append the landmark of one reading with its correlation to all else.

    F_p and F_z are the derivatives of :func:`..models.bearing_range.locate_landmark`,
    or those of another sensor::

        P_l* = F_p P_p*,    P_ll = F_p P_pp F_pᵀ + F_z Q F_zᵀ

    Not ``correlated``: P_l* = 0, the initialisation that makes a filter overconfident.
    """
    mean, P, reference = belief
    linearisation, c = rules.linearisation, size
    v0, v1 = variances(rules, read_distance_jit(z0, z1))
    pose = mean[0], mean[1], mean[2]
    lx, ly, turned_x, turned_y, xx, more_xx, xy, yy, more_yy = placed_jit(
        pose, z0, z1, v0, v1
    )
    mean[c], mean[c + 1] = lx, ly
    if linearisation in (AT_REFERENCE, PROJECTED):
        reference[c], reference[c + 1] = lx, ly
    if linearisation != AT_ESTIMATE:  # F_p at the point where H is
        turned_x = reference[1] - reference[c + 1]
        turned_y = reference[c] - reference[0]
    row_x, row_y = P[c], P[c + 1]
    for j in range(size):
        row_x[j] = P[0, j] + turned_x * P[2, j]
        row_y[j] = P[1, j] + turned_y * P[2, j]
    row_x[c] = row_x[0] + turned_x * row_x[2] + xx + more_xx
    row_y[c] = row_y[0] + turned_x * row_y[2] + xy
    row_y[c + 1] = row_y[1] + turned_y * row_y[2] + yy + more_yy
    row_x[c + 1] = row_y[c]
    for j in range(size):
        if not rules.correlated:
            row_x[j] = row_y[j] = 0.0
        P[j, c], P[j, c + 1] = row_x[j], row_y[j]


# --------------------------------------------------------------------------------------
# Kalman gain and update of mean and covariance, for many readings at once.

# Share of a variance below which the remainder counts as rounding.
SINGULAR = 1e-14

# Above this size of the state, one pass over P costs more than a triangular solve.
LARGE = 250
BLOCK = 6  # readings absorbed at a time below it


@njit_internal
def absorb(
    covariance: Array, size: int, rows: Array, columns: IntArray, used: int, block: int
) -> int:
    """Condition P on m simultaneous readings, and find the correction of the state.

    ::

        S = H P Hᵀ + Q = L Lᵀ,   A = L⁻¹ H P,   w = L⁻¹ ν
        δ = Aᵀ w,   P ← P − Aᵀ A,   NIS = wᵀ w

    All readings have one linearisation, so that their order does not matter.  P is
    downdated after each block of a few readings, which spares a small map most of the
    triangular solve.  With a single block P changes at the very end, which spares a
    large map the many passes over P.

    Parameters
    ----------
    covariance, size
        P.
    rows
        The workspace.  Read are, from its first system, JACOBIAN (H), VARIANCE (the
        diagonal of Q) and INNOVATION (ν).  Written are A, ROOT (the diagonal blocks of
        L), WHITE (w), and δ in the row CORRECTION.  Two rows below are overwritten.
    columns
        For each reading in use, its landmark's first column in P.
    used
        Number of readings in use.
    block
        How many readings to absorb at a time.

    Returns
    -------
    int
        -1 on success: the lower half of P is right, and :func:`restore_upper` completes
        P.  Otherwise the first row at which S is not positive definite: P is then
        invalid, unless that row lies in the first block.
    """
    system, bottom = rows[FIRST:], 2 * used
    begin_correction(size, rows, system, bottom)
    for first in range(0, bottom, 2 * block):
        last = min(first + 2 * block, bottom)
        if first > 0:
            refresh_pose(covariance, size)
            for column in columns[first // 2 : last // 2]:
                refresh(covariance, size, column)
        for row in range(first, last, 2):
            c = columns[row // 2]
            if not whiten(covariance, size, rows, system, first, row, c):
                return row
        downdate(covariance, size, system, first, last)
    return -1


@njit_internal
def begin_correction(size: int, rows: Array, system: Array, bottom: int) -> None:
    """Set δ to zero, and the two rows below the system, as :func:`downdate` asks."""
    delta = rows[CORRECTION]
    for j in range(_whole(size)):
        delta[j] = system[bottom, j] = system[bottom + 1, j] = 0.0


@njit_internal
def whiten(
    covariance: Array,
    size: int,
    rows: Array,
    system: Array,
    first: int,
    row: int,
    c: int,
) -> bool:
    """Fill A, L and w of the reading in ``row`` and the next, and add its share to δ.

    The rows of A from ``first`` on are finished, and P does not contain them yet.
    The function returns false where S is not positive definite; P stays as it is.
    """
    pair = system[row : row + 2]
    _correlate(covariance, size, pair, c)
    least = SINGULAR * _own_variance(pair, 0, c)
    least_below = SINGULAR * _own_variance(pair, 1, c)
    for before in range(first, row, 2):
        _orthogonalise(size, pair, system[before : before + 2], c)
    return _normalise(size, pair, rows[CORRECTION], c, least, least_below)


@njit_internal
def times(system: Array, row: int, c: int, vector: Array) -> float:
    """Multiply a row of H, whose landmark is in columns c and c + 1, by a vector."""
    h = system[row, JACOBIAN : JACOBIAN + 5]
    product = h[0] * vector[0] + h[1] * vector[1]
    product += h[2] * vector[2]
    return float(product + h[3] * vector[c] + h[4] * vector[c + 1])


@njit_internal
def _own_variance(system: Array, row: int, c: int) -> float:
    """Return the diagonal entry of H P Hᵀ + Q, with H P in the row of A."""
    variance: float = times(system, row, c, system[row]) + system[row, VARIANCE]
    return variance


@njit_internal
def _whole(size: int) -> int:
    """Round up to a multiple of 8: whole vector registers, no scalar remainder."""
    return (size + 7) & -8


@njit_apart
def _correlate(covariance: Array, size: int, pair: Array, c: int) -> None:
    """Fill the two rows of one reading in A with H P."""
    P = covariance
    a, b = pair[0, JACOBIAN : JACOBIAN + 5], pair[1, JACOBIAN : JACOBIAN + 5]
    a0, a1, a2, a3, a4 = a[0], a[1], a[2], a[3], a[4]
    b0, b1, b2, b3, b4 = b[0], b[1], b[2], b[3], b[4]
    for j in range((size + 3) & -4):
        p0, p1, p2, p3, p4 = P[0, j], P[1, j], P[2, j], P[c, j], P[c + 1, j]
        upper = fma(a4, p4, fma(a3, p3, fma(a2, p2, fma(a1, p1, a0 * p0))))
        lower = fma(b4, p4, fma(b3, p3, fma(b2, p2, fma(b1, p1, b0 * p0))))
        pair[0, j], pair[1, j] = upper, lower


@njit_apart
def _orthogonalise(size: int, pair: Array, done: Array, c: int) -> None:
    """Subtract from the rows of a reading in A their part along two finished rows.

    The factors are the reading's entries of L in the columns of those rows.
    """
    l00, l01 = times(pair, 0, c, done[0]), times(pair, 0, c, done[1])
    l10, l11 = times(pair, 1, c, done[0]), times(pair, 1, c, done[1])
    for j in range(_whole(size)):
        a0, a1 = done[0, j], done[1, j]
        pair[0, j] = fma(-l01, a1, fma(-l00, a0, pair[0, j]))
        pair[1, j] = fma(-l11, a1, fma(-l10, a0, pair[1, j]))


@njit_apart
def _normalise(
    size: int, pair: Array, delta: Array, c: int, least: float, least_below: float
) -> bool:
    """Divide the rows of a reading in A by the Cholesky factor of its block of S.

    The block is what the readings before leave of S.  The function returns false where
    only rounding is left.  It whitens ν likewise and adds its share to δ.
    """
    s00 = _own_variance(pair, 0, c)
    s10 = times(pair, 1, c, pair[0])
    s11 = _own_variance(pair, 1, c)
    if not s00 > least:
        return False
    l00 = np.sqrt(s00)
    l10 = s10 / l00
    rest = s11 - l10 * l10
    if not rest > least_below:
        return False
    l11 = np.sqrt(rest)
    pair[0, ROOT], pair[0, ROOT + 1] = l00, 0.0
    pair[1, ROOT], pair[1, ROOT + 1] = l10, l11
    inverse0, inverse1 = 1 / l00, 1 / l11
    w0 = (pair[0, INNOVATION] - times(pair, 0, c, delta)) * inverse0
    w1 = pair[1, INNOVATION] - times(pair, 1, c, delta)
    w1 = (w1 - l10 * w0) * inverse1
    pair[0, WHITE], pair[1, WHITE] = w0, w1
    for j in range(_whole(size)):
        a0 = pair[0, j] * inverse0
        a1 = fma(-l10, a0, pair[1, j]) * inverse1
        pair[0, j], pair[1, j] = a0, a1
        delta[j] = fma(w1, a1, fma(w0, a0, delta[j]))
    return True


@njit_apart
def downdate(
    covariance: Array, size: int, system: Array, first: int, last: int
) -> None:
    """P ← P − Aᵀ A with rows ``first`` to ``last`` of A; lower half of P only.

    The loop takes four rows of P and four of A at a time, which fills the registers of
    a processor.  Where ``last`` ends a group of two, the next two rows of A must be
    zero.
    """
    A, P = system, covariance
    one, two, three, four = np.uint64(1), np.uint64(2), np.uint64(3), np.uint64(4)
    end = np.uint64((size + 3) & -4)  # unsigned, so that no index counts from the end
    for i in range(np.uint64(0), end, four):
        i1, i2, i3 = i + one, i + two, i + three
        width = (i + np.uint64(11)) & ~np.uint64(7)  # whole registers: rather too much
        width = min(width, end & ~np.uint64(7))
        for k in range(np.uint64(first), np.uint64(last), four):
            k1, k2, k3 = k + one, k + two, k + three
            b0, b1, b2, b3 = -A[k, i], -A[k1, i], -A[k2, i], -A[k3, i]
            c0, c1, c2, c3 = -A[k, i1], -A[k1, i1], -A[k2, i1], -A[k3, i1]
            d0, d1, d2, d3 = -A[k, i2], -A[k1, i2], -A[k2, i2], -A[k3, i2]
            e0, e1, e2, e3 = -A[k, i3], -A[k1, i3], -A[k2, i3], -A[k3, i3]
            for j in range(width):
                a0, a1, a2, a3 = A[k, j], A[k1, j], A[k2, j], A[k3, j]
                p, q, r, s = P[i, j], P[i1, j], P[i2, j], P[i3, j]
                P[i, j] = fma(b3, a3, fma(b2, a2, fma(b1, a1, fma(b0, a0, p))))
                P[i1, j] = fma(c3, a3, fma(c2, a2, fma(c1, a1, fma(c0, a0, q))))
                P[i2, j] = fma(d3, a3, fma(d2, a2, fma(d1, a1, fma(d0, a0, r))))
                P[i3, j] = fma(e3, a3, fma(e2, a2, fma(e1, a1, fma(e0, a0, s))))
    for i in range(end & ~np.uint64(7), end):  # the last corner
        for j in range(end & ~np.uint64(7), i + one):
            rest = P[i, j]
            for k in range(np.uint64(first), np.uint64(last)):
                rest = fma(-A[k, i], A[k, j], rest)
            P[i, j] = rest


@njit_internal
def refresh_pose(covariance: Array, size: int) -> None:
    """Complete the rows of the pose, and the row below them."""
    for row in range(0, 4, 2):
        refresh(covariance, size, row)


@njit_internal
def refresh(covariance: Array, size: int, row: int) -> None:
    """Copy two columns of the lower half into their rows."""
    covariance[row, row + 1] = covariance[row + 1, row]
    for j in range(row + 2, size):
        covariance[row, j] = covariance[j, row]
        covariance[row + 1, j] = covariance[j, row + 1]


@njit_internal
def restore_upper(covariance: Array, size: int) -> None:
    """Copy the lower half into the upper; if P is large, into the rows of the pose."""
    if size <= LARGE:
        mirror(covariance, size)
    else:
        refresh_pose(covariance, size)


@njit_internal
def mirror(covariance: Array, size: int) -> None:
    """Copy the lower half into the upper, in tiles of 4 × 4."""
    for i in range(0, size, 4):
        for j in range(0, i, 4):
            for a in range(i, i + 4):
                for b in range(j, j + 4):
                    covariance[b, a] = covariance[a, b]
        for a in range(i + 1, i + 4):
            for b in range(i, a):
                covariance[b, a] = covariance[a, b]


# --------------------------------------------------------------------------------------
# The correction of the state: δ is composed with the mean, and P follows.


@njit_internal
def compose(mean: Array, base: Array, rows: Array, size: int, frame: int) -> None:
    """Compose the correction δ with the state ``base``, by the error frame."""
    if frame == INVARIANT:
        retract(mean, base, rows, size)
        return
    for j in range(size):
        mean[j] = base[j] + rows[CORRECTION, j]


@njit_internal
def retract(mean: Array, base: Array, rows: Array, size: int) -> None:
    """Compose an invariant correction δ with a state, in place of adding it.

    With t = δθ and every point q, the robot's position and each landmark::

        q⁺ = R(t) q + V(t) (δq − t J q⁻),    θ⁺ = θ + t

    with R, V and J of :mod:`..models.rigid_motion`, and q⁻ of the prior mean, whose
    coordinates δ has.  The row TRANSPORT becomes v = J (q⁺ − q⁻), 0 at θ, for
    :func:`transport`.
    """
    delta, prior, v = rows[CORRECTION], rows[MEAN_BEFORE], rows[TRANSPORT]
    turned = turn_coefficients_jit(delta[2])
    for i in range(-1, size // 2 - 1):
        c = 3 + 2 * i if i >= 0 else 0  # the pose first, then the landmarks
        retract_point(mean, base, prior, delta, turned, c)
        v[c], v[c + 1] = prior[c + 1] - mean[c + 1], mean[c] - prior[c]
    mean[2] = base[2] + delta[2]
    v[2] = 0.0


@njit_internal
def retract_point(
    mean: Array,
    base: Array,
    prior: Array,
    delta: Array,
    turned: tuple[float, float, float, float],
    c: int,
) -> None:
    """Retract the point in columns c and c + 1."""
    cos, sin, even, odd = turned
    x, y, t = base[c], base[c + 1], delta[2]
    ux, uy = delta[c] + t * prior[c + 1], delta[c + 1] - t * prior[c]
    mean[c] = cos * x - sin * y + even * ux - odd * uy
    mean[c + 1] = sin * x + cos * y + odd * ux + even * uy


@njit_internal
def transport(covariance: Array, rows: Array, size: int) -> None:
    """P ← T P Tᵀ with T = I + v e_θᵀ and v in the row TRANSPORT; lower half only.

    P is constant in invariant coordinates; T reads it at the corrected estimate.  The
    row HEADING is overwritten with c = P[:, θ].
    """
    v, c = rows[TRANSPORT], rows[HEADING]
    for j in range(size):
        c[j] = covariance[2, j] if j < 2 else covariance[j, 2]
    variance = c[2]
    for i in range(size):
        v_i = v[i]
        rest = c[i] + variance * v_i
        for j in range(i + 1):
            moved = fma(v_i, c[j], covariance[i, j])
            covariance[i, j] = fma(rest, v[j], moved)


# --------------------------------------------------------------------------------------
# Rules of an update: what distinguishes one filter of the family from another.

# Where Jacobians are taken.
AT_ESTIMATE = 0
AT_REFERENCE = 1  # at fixed points kept beside the estimate
PROJECTED = 2  # at the estimate, then made blind to a rotation of the whole map
AT_TRUTH = 3  # at the ground truth, for study

# Error frame: how a correction is composed with the state.
ADDITIVE = 0
INVARIANT = 1
FRAMES: dict[int, ErrorFrame] = {ADDITIVE: "additive", INVARIANT: "invariant"}


class Rules(NamedTuple):
    """What distinguishes one filter's update from another's; plain numbers."""

    linearisation: int = AT_ESTIMATE
    frame: int = ADDITIVE
    iterations: int = 1  # most linearisations of a reading
    adaptive: bool = False  # linearise again only where a reading asks for it
    correlated: bool = True  # a new landmark with the pose it was seen from
    first_std: float = 0.0  # and the next: the four numbers of the sensor's `std`
    second_std: float = 0.0
    std_per_metre: float = 0.0
    std_metres: float = 0.0
    min_range: float = 1e-3  # [m]
    gate: float = np.inf  # largest NIS of one reading
    noise_as_read: bool = False  # take noise at the range as read, not as expected
    numbers: int = 2  # that a reading has; of one, the second row is void


ITERATIONS = Rules._fields.index("iterations")
#: Column of the first of the four standard deviations of a reading in the rules.
FIRST_STD = Rules._fields.index("first_std")
AFTER_STDS = Rules._fields.index("min_range")
NUMBERS_READ = Rules._fields.index("numbers")


# --------------------------------------------------------------------------------------
# Room for the intermediate results of one update, and the layout of its rows.
#
# ``docs/kernels.md`` has a picture of them.

# The first rows are vectors over the whole state.
CORRECTION = 0  # δ
TRANSPORT = 1  # v of the transport T = I + v e_θᵀ
ITERATE = 2  # where the readings are linearised again
HEADING = 3  # P[:, θ]
MEAN_BEFORE = 4  # the prior mean

# The stacked system follows: two rows (bearing, range) for each reading in use.  Such a
# row begins with its row of A and ends with META_WIDTH more columns, which are counted
# from the end.  Rules that iterate have a second system below it, for readings that are
# linearised again.
FIRST = 5
READING = -1  # z
VARIANCE = -2  # diagonal of Q
INNOVATION = -3  # ν
WHITE = -4  # w = L⁻¹ ν
ROOT = -6  # and the next: row of the diagonal block of L
JACOBIAN = -11  # and the next four: row of H, by x, y, θ, landmark x, landmark y
LANDMARK_X, LANDMARK_Y = JACOBIAN + 3, JACOBIAN + 4
META_WIDTH = 16

# Rows of the ledger of one scan.
SLOT = 0  # of each reading: place of its landmark in the map, negative for a new one
OUTCOME = 1  # of each reading: USED, ADDED, GATED, SKIPPED or WAITING
NEAR = 2  # of each reading: 1 where the robot is within 10 σ of its landmark
COLUMN = 3  # of each reading in use: its landmark's first column in the state
ORDER = 4  # the readings in use in the order in which they are taken one by one
LEDGER_HEIGHT = 5

# Outcomes of a reading.
USED, ADDED, GATED, SKIPPED = 0, 1, 2, 3
WAITING = 4  # of a new landmark that one reading does not place


class Workspace(NamedTuple):
    """Room for one update; every row begins on a cache line."""

    rows: Array  # (FIRST + 2m + 2, capacity + META_WIDTH), two systems to iterate
    before: Array  # empty, or square with room for P, to restore it after a failure


def workspace_for(rules: Rules, readings: int, capacity: int) -> Workspace:
    """Allocate what updates by these rules need.

    Parameters
    ----------
    rules : Rules
        Whether updates may linearise more than once.
    readings, capacity : int
        Most readings in one scan, and length of the mean.
    """
    systems = (2 if rules.iterations > 1 else 1) * (2 * readings + 2)
    kept = capacity * (readings > BLOCK)  # else no update fails after it has changed P
    return Workspace(
        aligned_zeros(FIRST + systems, (capacity + 7) // 8 * 8 + META_WIDTH),
        aligned_zeros(kept, kept),
    )


class BeliefArrays(NamedTuple):
    """One run's belief, which kernels change in place.

    The first ``size`` = 3 + 2n entries are in use, in the order (x, y, θ, l1x, l1y, …),
    and the others are zero.  ``capacity`` is a multiple of 4 above ``size``, so that
    loops may run over whole vector registers.
    """

    mean: Array  # (capacity,)
    covariance: Array  # (capacity, capacity)
    reference: Array  # (capacity,) fixed points for Jacobians, where the rules use them
