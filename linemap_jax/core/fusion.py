"""Sections 5.1.2 and 5.2.2: a better estimate from two matching primitives, Eqs. (23)-(25).

Eq. (23) as printed, C_r = C_l - K C_l, loses positive definiteness in float32, and it takes scans for independent. Here
the covariance is a sum of squares (Joseph's form), at the anchor of the map's line, and what a persisting pose error
contributes goes through the fusion apart from the rest. Pieces of one line in one scan share the pose: their
measurement parts are combined first, and the pose error is added once.
"""

import dataclasses
from typing import TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from linemap_jax.core.frames import dot, perp, shift_matrix, unit, wrap_angle
from linemap_jax.core.matching import CircleMatches, compare_lines, with_sign
from linemap_jax.core.propagation import apply, inverse, product, safe_sqrt, square_root, symmetric
from linemap_jax.core.settings import Number, PoseError, Rules, Thresholds
from linemap_jax.core.slots import choose, computed_once, first_of_group, least, put, take
from linemap_jax.core.state import Circles, Lines, Pose, pytree, squared

JACOBIAN_ERROR = 0.005
"""How well A is known, relative to its size: to first order, with a heading that is a third of a degree off. A gain
that lets an error that persists cancel between two viewpoints would believe in A to the last digit."""


@pytree
class Errors:
    """The error of an estimate of n numbers, in the two parts of `Lines` and `Circles`."""

    cov_independent: Float[Array, "*s n n"]
    """Covariance of what no other scan shares."""
    sqrt_persistent: Float[Array, "*s n 3"]
    """Square root of the covariance of what other scans may share."""
    times_detected: Int[Array, "*s"]
    """How many scans have seen the primitive."""


ErrorsT = TypeVar("ErrorsT", Errors, Lines, Circles)


def combine(old: Errors, new: Errors, pose_error: PoseError) -> tuple[Float[Array, "*s n n"], Errors]:
    """The gain K of x = x_old + K (x_new - x_old), and the error of x: Eq. (23) for both parts of the error.

    Whatever the gain, the independent part is (I - K) C_old (I - K)^T + K C_new K^T, formed as squares, which
    no rounding makes indefinite. With A_old and A_new for the square roots of what persists:

    "independent" and "persistent": both errors hold the same u (if there is any), and their parts add up as
    (I - K) A_old + K A_new. With D = A_new - A_old the best gain is
    K = (C_old - A_old D^T) (C_old + C_new + D D^T)^-1, that of a Schmidt-Kalman filter, which considers u but does not
    estimate it. Where nothing persists, that is Eq. (23). C_new holds `JACOBIAN_ERROR` too.

    "unknown": any correlation is possible. For each w in (0, 1) the persisting part is bounded by
    (I - K) A_old A_old^T (I - K)^T / w + K A_new A_new^T K^T / (1 - w), split covariance intersection (Julier and
    Uhlmann 2001). The gain is the best one for w = n_old / (n_old + n_new), so that views that are equally good are
    averaged; then w is the one that makes the bound least for this gain.

    Args:
      old: of the map's primitive.
      new: of what was observed.
      pose_error: the model of the pose error.

    Returns:
      K, shape `[*s, n, n]`, and the error of the result; its times are those of both.
    """
    c_old, a_old = old.cov_independent, old.sqrt_persistent
    c_new, a_new = new.cov_independent, new.sqrt_persistent
    if pose_error == "persistent":
        c_new = c_new + JACOBIAN_ERROR**2 * squared(a_new)
    times = old.times_detected + new.times_detected
    difference = a_new - a_old
    if pose_error == "unknown":
        # As floats of the right kind: the quotient of two int32 is a float32.
        w = (old.times_detected.astype(c_old.dtype) / times.astype(c_old.dtype))[..., None, None]
        before = c_old + squared(a_old) / w
        innovation = before + c_new + squared(a_new) / (1 - w)
    else:
        before = c_old - product(a_old, jnp.swapaxes(difference, -1, -2))
        innovation = c_old + c_new + squared(difference)
    unit = inverse(symmetric(innovation))
    gain = product(before, unit)
    keep = jnp.broadcast_to(jnp.eye(gain.shape[-1], dtype=gain.dtype), gain.shape) - gain
    # Squares of roots: of K C K^T, multiplied out, a large gain leaves rounding errors larger than C.
    independent = squared(product(keep, square_root(c_old))) + squared(product(gain, square_root(c_new)))
    if pose_error == "unknown":
        a_old, a_new = product(keep, a_old), product(gain, a_new)
        # 1 / w = 1 + b / a and 1 / (1 - w) = 1 + a / b, with a and b the sizes of both terms
        a, b = (_size(squared(x), unit) for x in (a_old, a_new))
        some = (a > 0) & (b > 0)
        ratio = jnp.where(some, b / jnp.where(some, a, 1), 1)[..., None, None]
        bound = squared(a_old) * (1 + ratio) + squared(a_new) * (1 + 1 / ratio)
        bound = jnp.where(some[..., None, None], bound, squared(a_old) + squared(a_new))
        root = square_root(bound)
        persistent = jnp.zeros_like(a_old).at[..., : root.shape[-1]].set(root)
    else:
        # (I - K) A_old + K A_new, in the form that keeps A to the last digit where both views share all of it
        persistent = a_old + product(gain, difference)
    return gain, Errors(cov_independent=independent, sqrt_persistent=persistent, times_detected=times)


def forget(primitives: ErrorsT, share: Number) -> ErrorsT:
    """Lines or circles of whose persisting variance only a share persists; the rest counts as independent.

    The whole covariance does not change. For what one scan has seen this brings in the share of the pose error that
    persists. For a map one scan later: of u[k] = a u[k+1] + sqrt(1 - a^2) w only a share of a^2 is still there.

    Args:
      primitives: lines or circles, or what else has errors in two parts.
      share: of the persisting variance, from 0 to 1.

    Returns:
      The same estimates with the same covariance, otherwise divided.
    """
    return dataclasses.replace(
        primitives,
        cov_independent=primitives.cov_independent + (1 - share) * squared(primitives.sqrt_persistent),
        sqrt_persistent=jnp.sqrt(share) * primitives.sqrt_persistent,
    )


def at_first_angle(pieces: Lines, model: Lines, pose: Pose) -> Lines:
    """Pieces of lines, with the share of the pose error reckoned at the angle at which their line was first seen.

    A scan moves with its pose as a rigid body: d(offset, angle) / d(x, y, theta) is the normal and the lever of the
    robot, and (0, 0, 1). Taken at each piece's own angle, two views from one pose would differ in it by noise, and a
    gain that lets an error that persists cancel between views would learn from that difference.

    Args:
      pieces: what a scan observed. Those on which the pose error has no influence stay as they are.
      model: for each piece the line that it belongs to.
      pose: of the robot.

    Returns:
      The pieces, with another `sqrt_persistent`.
    """
    # Reversed, the normal of the first view points the other way.
    angle = model.first_angle + jnp.where(dot(unit(model.first_angle), pieces.normal) < 0, jnp.pi, 0)
    normal = unit(angle)
    lever = dot(perp(normal), pose.mean[None, :2] - pieces.anchor)
    by_offset = jnp.concatenate([normal, lever[:, None]], -1)
    by_angle = jnp.zeros_like(by_offset).at[:, 2].set(1)
    root = product(jnp.stack([by_offset, by_angle], 1), square_root(pose.cov)[None])
    some = jnp.any(pieces.sqrt_persistent != 0, (-2, -1))
    return dataclasses.replace(pieces, sqrt_persistent=jnp.where(some[:, None, None], root, pieces.sqrt_persistent))


def _size(cov: Float[Array, "*s n n"], unit: Float[Array, "*s n n"]) -> Float[Array, "*s"]:
    """The square root of the trace of a covariance, measured by an information matrix."""
    return safe_sqrt(jnp.sum(cov * unit, (-1, -2)))


def fuse_lines(
    model: Lines,
    has_prior: Bool[Array, " L"],
    pieces: Lines,
    together: Bool[Array, "L L"],
    thresholds: Thresholds,
    rules: Rules,
    pose_error: PoseError,
    share: Number = 1.0,
) -> Lines:
    """Eq. (23) and the end points of section 5.1.2: each piece's line, improved by all pieces that are parts of it.

    Args:
      model: for each piece the line that it belongs to. A line that is new is the piece that leads its group: the point
        to linearise at.
      has_prior: false for new lines, whose covariance counts for nothing.
      pieces: what one scan observed. All of the pose error, which they share, stands in `sqrt_persistent`.
      together: which pieces belong to one line; such pieces have the same `model`, and get the same result.
      thresholds: `end_sigmas`.
      rules: `estimate_ends`.
      pose_error: its model.
      share: of the pose error that persists; the rest counts as independent once the pieces have been combined. Where
        nothing persists it is 0: with "independent" and 0 this is Eq. (23).

    Returns:
      The improved lines, one for each piece. Rows of `together` that are empty give nonsense.
    """
    count = has_prior.shape[0]

    def in_map(piece: Lines, line: Lines) -> Array:
        """Information of one piece about its line, at the line's anchor: matrix, what the pose adds, vector."""
        pair = compare_lines(piece, line, thresholds, pose_error)
        shift = shift_matrix(pair.lever)
        weight = product(shift.T, inverse(with_sign(piece.cov_independent, pair.sign)))
        turned = piece.sqrt_persistent * jnp.stack([pair.sign, jnp.ones_like(pair.sign)])[:, None]
        innovation = jnp.stack([pair.offset, pair.angle])
        return jnp.concatenate(
            [product(weight, shift), product(weight, turned), apply(weight, innovation)[:, None]], -1
        )

    parts = jax.vmap(in_map)(pieces, model)
    member = together.astype(parts.dtype)
    total = jnp.dot(member, parts.reshape(count, -1), precision=jax.lax.Precision.HIGHEST).reshape(parts.shape)
    cov_seen = symmetric(inverse(total[..., :2]))
    by_pose = product(cov_seen, total[..., 2:5])
    times = jnp.max(jnp.where(together, pieces.times_detected[None], 1), -1)
    seen = forget(Errors(cov_independent=cov_seen, sqrt_persistent=by_pose, times_detected=times), share)
    gain, errors = combine(_errors(model), seen, pose_error)

    first_seen = ~has_prior[:, None, None]
    gain = jnp.where(first_seen, jnp.eye(2, dtype=gain.dtype)[None], gain)
    change = apply(product(gain, cov_seen), total[..., 5])
    fused = dataclasses.replace(
        model,
        offset=model.offset + change[:, 0],
        angle=wrap_angle(model.angle + change[:, 1]),
        cov_independent=jnp.where(first_seen, seen.cov_independent, errors.cov_independent),
        sqrt_persistent=jnp.where(first_seen, seen.sqrt_persistent, errors.sqrt_persistent),
        times_detected=jnp.where(has_prior, errors.times_detected, times),
    )
    return _fuse_ends(fused, has_prior, pieces, together, thresholds, rules)


def _fuse_ends(
    model: Lines,
    has_prior: Bool[Array, " L"],
    pieces: Lines,
    together: Bool[Array, "L L"],
    thresholds: Thresholds,
    rules: Rules,
) -> Lines:
    """The end points of section 5.1.2: those of the pieces are projected on the new line and held against the old ones.

    The paper replaces an end point whenever that makes the line longer: with noise, it grows without end (11 cm in 50
    scans at 5 cm of pose error). By default end points that agree within their spread are averaged by their variances;
    an observed end well beyond the old one replaces it, and one well short of it (the rest was hidden) does nothing.
    """

    def on_line(rows: tuple[Lines, Lines]) -> Array:
        """The ends of each piece, along its line."""
        line, piece = rows
        # From anchor to anchor: coordinates of the world have fewer digits far from its origin.
        middle = piece.anchor - line.anchor + piece.offset[:, None] * piece.normal
        return dot(line.tangent, middle)[:, None] + dot(line.tangent, piece.tangent)[:, None] * piece.extent

    along: Array = computed_once(on_line, (model, pieces))

    def outermost(direction: int, old: Array, var_old: Array) -> tuple[Array, Array]:
        """The lower end for direction -1, the upper one for +1, in coordinates in which larger is longer."""
        reach = direction * along
        second = reach[:, 1] > reach[:, 0]
        mine = jnp.where(second, reach[:, 1], reach[:, 0])
        var_mine = jnp.where(second, pieces.var_extent[:, 1], pieces.var_extent[:, 0])
        piece, new = least(jnp.where(together, -mine[None], jnp.inf))
        new, var_new = -new, var_mine[piece]
        old = direction * old
        longer = new > old
        if rules.estimate_ends:
            band = thresholds.end_sigmas * jnp.sqrt(var_new + var_old)
            longer = new > old + band
            agree = jnp.abs(new - old) <= band
            mean = (old * var_new + new * var_old) / (var_new + var_old)
            old = jnp.where(agree, mean, old)
            var_old = jnp.where(agree, var_new * var_old / (var_new + var_old), var_old)
        longer = longer | ~has_prior
        return direction * jnp.where(longer, new, old), jnp.where(longer, var_new, var_old)

    ends = [outermost(d, model.extent[:, i], model.var_extent[:, i]) for i, d in ((0, -1), (1, 1))]
    extent, var_extent = (jnp.stack(both, -1) for both in zip(*ends, strict=True))
    return dataclasses.replace(model, extent=extent, var_extent=var_extent)


def fuse_circles(model: Circles, new: Circles, matches: CircleMatches, rules: Rules, pose_error: PoseError) -> Circles:
    """A better estimate of the map's circles from the new ones that match them: section 5.2.2.

    `weigh_circles` false: Eqs. (24)-(25), the mean of old and new; the print of (24) repeats y_cn where it means y_cm.
    True: fitted circles by their covariances; where only one of the two is fitted, that one stands, since the other
    describes no more than the visible arc; unfitted ones by the number of times that they were seen.

    Args:
      model: the circles of the map.
      new: the circles of a scan, or of another map.
      matches: which is which. Several new ones that match one of the map are averaged first (of fitted ones, the
        nearest is taken).
      rules: `weigh_circles`.
      pose_error: its model.

    Returns:
      The circles of the map, those that were matched improved.
    """
    matched = matches.slot >= 0
    together = (matches.slot[:, None] == matches.slot[None]) & matched[:, None]
    # A mean of none divides by one.
    count = jnp.maximum(jnp.sum(together, -1), 1).astype(new.radius.dtype)
    mine = take(model, matches.slot)
    old, seen = (jnp.concatenate([x.center, x.radius[:, None]], -1) for x in (mine, new))
    mean = jnp.sum(jnp.where(together[..., None], seen[None], 0), 1) / count[:, None]
    times = mine.times_detected
    times_new = jnp.max(jnp.where(together, new.times_detected[None], 1), -1)
    errors = _errors(mine)

    if not rules.weigh_circles:
        fused, fitted = (old + mean) / 2, mine.fitted
    else:
        weight = times_new.astype(count.dtype) / (times + times_new).astype(count.dtype)
        running = old + weight[:, None] * (mean - old)
        # The nearest fitted one of those that match
        which, nearest = least(jnp.where(together & new.fitted[None], matches.distance[None], jnp.inf))
        has_fit = jnp.isfinite(nearest)
        seen, errors_seen = seen[which], _errors(take(new, which))

        both = (has_fit & mine.fitted)[:, None, None]
        alike = _at_radius(errors_seen, seen[:, 2], old[:, 2], both)
        gain, joint = combine(_or_neutral(errors, both), _or_neutral(alike, both), pose_error)

        fused = jnp.where(mine.fitted[:, None], old, running)
        fused = jnp.where(has_fit[:, None], seen, fused)
        fused = jnp.where(both[..., 0], old + apply(gain, seen - old), fused)
        joint = _at_radius(joint, old[:, 2], fused[:, 2], both)
        errors = choose(both[:, 0, 0], joint, choose(has_fit, errors_seen, errors))
        fitted = mine.fitted | has_fit

    improved = dataclasses.replace(
        mine,
        center=fused[:, :2],
        radius=fused[:, 2],
        cov_independent=errors.cov_independent,
        sqrt_persistent=errors.sqrt_persistent,
        fitted=fitted,
        times_detected=times + times_new,
    )
    # All that match one circle have the same result; the first one writes it.
    return put(model, jnp.where(first_of_group(together), matches.slot, -1), improved)


def _at_radius(
    errors: Errors, radius: Float[Array, " K"], other: Float[Array, " K"], meant: Bool[Array, "K 1 1"]
) -> Errors:
    """The errors of fitted circles that were taken at one radius, at another one, for those that are meant.

    What ranges tell is the curvature: the variance of 1 / R hardly depends on R, and so that of R grows as R^4. Taken
    as they are, scans in which noise made a pole too small would weigh more than those in which it made it too large,
    and after fifty scans the pole would be too small by two sigma. The part of the errors of the centre that goes with
    the radius grows alike.
    """
    positive = meant[:, 0, 0] & (radius > 0) & (other > 0)
    growth = jnp.where(positive, other / jnp.where(positive, radius, 1), 1) ** 4 - 1
    cov = errors.cov_independent
    var = jnp.where(positive & (cov[:, 2, 2] > 0), cov[:, 2, 2], 1)
    with_radius = cov[:, :, 2, None] * cov[:, None, 2, :] / var[:, None, None]
    return dataclasses.replace(errors, cov_independent=cov + growth[:, None, None] * with_radius)


def _errors(primitives: Lines | Circles) -> Errors:
    return Errors(
        cov_independent=primitives.cov_independent,
        sqrt_persistent=primitives.sqrt_persistent,
        times_detected=primitives.times_detected,
    )


def _or_neutral(errors: Errors, meant: Bool[Array, "K 1 1"]) -> Errors:
    """The errors that are meant; elsewhere some that give no NaN."""
    eye = jnp.eye(errors.cov_independent.shape[-1], dtype=errors.cov_independent.dtype)
    return Errors(
        cov_independent=jnp.where(meant, errors.cov_independent, eye[None]),
        sqrt_persistent=jnp.where(meant, errors.sqrt_persistent, 0),
        times_detected=jnp.where(meant[:, 0, 0], errors.times_detected, 1),
    )
