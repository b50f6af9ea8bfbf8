"""Sections 5.1.2 and 5.2.2: a better estimate from two matching primitives, Eqs. (23)-(25).

Eq. (23) as printed, K = C_l (C_l + C_m)^-1 and so on, loses positive definiteness in float32. The same estimate is
formed from information matrices, at the anchor of the map's line. Pieces of one line in one scan share the pose: their
measurement parts are combined first, and the pose error is added once.
"""

import dataclasses

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from linemap_jax.core.frames import dot, shift_matrix, wrap_angle
from linemap_jax.core.matching import CircleMatches, compare_lines, with_sign
from linemap_jax.core.propagation import apply, inverse, product, propagate, symmetric
from linemap_jax.core.settings import Rules, Thresholds
from linemap_jax.core.slots import least
from linemap_jax.core.state import Circles, Lines, pytree


@pytree
class Pieces:
    """Observed pieces of lines."""

    lines: Lines
    cov_measurement: Float[Array, "L 2 2"]  # of (offset, angle), not shared with other pieces
    jac_line_pose: Float[Array, "L 2 3"]  # what they share


def fuse_lines(
    model: Lines,
    has_prior: Bool[Array, " L"],
    pieces: Pieces,
    together: Bool[Array, "L L"],
    cov_pose: Float[Array, "3 3"],
    thresholds: Thresholds,
    rules: Rules,
) -> Lines:
    """Eq. (23) and the end points of section 5.1.2: each piece's line, improved by all pieces that are parts of it.

    Args:
      model: for each piece the line that it belongs to. A line that is new is the piece that leads its group: the point
        to linearise at.
      has_prior: false for new lines, whose covariance counts for nothing.
      pieces: what was observed. Pieces of one line are taken to move with the pose as one line does: their Jacobians
        agree once they are moved to one anchor.
      together: which pieces belong to one line; such pieces have the same `model`, and get the same result.
      cov_pose: covariance of the pose that the pieces share.
      thresholds: `end_sigmas`.
      rules: `estimate_ends`.

    Returns:
      The improved lines, one for each piece. Rows of `together` that are empty give nonsense.
    """
    count = has_prior.shape[0]

    def in_map(piece: Lines, line: Lines, cov: Array, jac: Array) -> Array:
        """Information of one piece about its line, at the line's anchor: matrix, what the pose adds, vector."""
        pair = compare_lines(piece, line, thresholds)
        shift = shift_matrix(pair.lever)
        weight = product(shift.T, inverse(with_sign(cov, pair.sign)))
        turned = jac * jnp.stack([pair.sign, jnp.ones_like(pair.sign)])[:, None]
        innovation = jnp.stack([pair.offset, pair.angle])
        return jnp.concatenate(
            [product(weight, shift), product(weight, turned), apply(weight, innovation)[:, None]], -1
        )

    parts = jax.vmap(in_map)(pieces.lines, model, pieces.cov_measurement, pieces.jac_line_pose)
    member = together.astype(parts.dtype)
    total = jnp.dot(member, parts.reshape(count, -1), precision=jax.lax.Precision.HIGHEST).reshape(parts.shape)
    information, by_pose, vector = total[..., :2], total[..., 2:5], total[..., 5]

    cov_measurement = inverse(information)
    seen = apply(cov_measurement, vector)
    cov_seen = cov_measurement + propagate(product(cov_measurement, by_pose), cov_pose)
    information_seen = inverse(cov_seen)
    prior = jnp.where(has_prior[:, None, None], inverse(model.cov), 0)
    cov = symmetric(inverse(prior + information_seen))
    change = apply(cov, apply(information_seen, seen))
    fused = dataclasses.replace(
        model,
        offset=model.offset + change[:, 0],
        angle=wrap_angle(model.angle + change[:, 1]),
        cov=cov,
        times_detected=jnp.where(has_prior, model.times_detected + 1, 1),
    )
    return _fuse_ends(fused, has_prior, pieces, together, thresholds, rules)


def _fuse_ends(
    model: Lines,
    has_prior: Bool[Array, " L"],
    pieces: Pieces,
    together: Bool[Array, "L L"],
    thresholds: Thresholds,
    rules: Rules,
) -> Lines:
    """The end points of section 5.1.2: those of the pieces are projected on the new line and held against the old ones.

    The paper replaces an end point whenever that makes the line longer: with noise, it grows without end (11 cm in 50
    scans at 5 cm of pose error). By default end points that agree within their spread are averaged by their variances;
    an observed end well beyond the old one replaces it, and one well short of it (the rest was hidden) does nothing.
    """
    tangent = model.tangent
    along = jnp.stack([dot(tangent, end - model.anchor) for end in (pieces.lines.begin, pieces.lines.end)], -1)

    def outermost(direction: int, old: Array, var_old: Array) -> tuple[Array, Array]:
        """The lower end for direction -1, the upper one for +1, in coordinates in which larger is longer."""
        reach = direction * along
        second = reach[:, 1] > reach[:, 0]
        mine = jnp.where(second, reach[:, 1], reach[:, 0])
        var_mine = jnp.where(second, pieces.lines.var_extent[:, 1], pieces.lines.var_extent[:, 0])
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


def fuse_circles(model: Circles, new: Circles, matches: CircleMatches, rules: Rules) -> Circles:
    """A better estimate of the map's circles from the new ones that match them: section 5.2.2.

    `weigh_circles` false: Eqs. (24)-(25), the mean of old and new; the print of (24) repeats y_cn where it means y_cm.
    True: fitted circles by their covariances; where only one of the two is fitted, that one stands, since the other
    describes no more than the visible arc; unfitted ones by the number of times that they were seen.

    Args:
      model: the circles of the map.
      new: the circles of a scan.
      matches: which is which. Several new ones that match one of the map are averaged first (of fitted ones, the
        nearest is taken).
      rules: `weigh_circles`.
    """
    k = model.valid.shape[0]
    into = jnp.where(matches.slot < 0, k, matches.slot)
    count = jax.ops.segment_sum(jnp.ones_like(into), into, k)
    touched = count > 0
    n = jnp.maximum(count, 1).astype(model.radius.dtype)
    as_vector = jnp.concatenate([new.center, new.radius[:, None]], -1)
    old = jnp.concatenate([model.center, model.radius[:, None]], -1)
    mean = jax.ops.segment_sum(as_vector, into, k) / n[:, None]

    if not rules.weigh_circles:
        fused, cov, fitted = (old + mean) / 2, model.cov, model.fitted
    else:
        weight = 1 / (model.times_detected + 1).astype(n.dtype)
        running = old + weight[:, None] * (mean - old)
        # The nearest fitted one of those that match
        distance = jnp.where(new.fitted, matches.distance, jnp.inf)
        nearest = jax.ops.segment_min(distance, into, k)
        at = jnp.maximum(matches.slot, 0)
        chosen = new.fitted & (matches.slot >= 0) & (distance == nearest[at])
        index = jnp.where(chosen, jnp.arange(into.shape[0]), into.shape[0])
        which = jnp.minimum(jax.ops.segment_min(index, into, k), into.shape[0] - 1)
        has_fit = jnp.isfinite(nearest) & touched
        seen, cov_seen = as_vector[which], new.cov[which]
        both = has_fit & model.fitted
        eye = jnp.eye(3, dtype=n.dtype)[None]
        prior = inverse(jnp.where(both[:, None, None], model.cov, eye))
        gain = inverse(jnp.where(both[:, None, None], cov_seen, eye))
        cov_both = symmetric(inverse(prior + gain))
        joint = old + apply(cov_both, apply(gain, seen - old))

        fused = jnp.where(
            both[:, None],
            joint,
            jnp.where(has_fit[:, None], seen, jnp.where(model.fitted[:, None], old, running)),
        )
        cov = jnp.where(both[:, None, None], cov_both, jnp.where(has_fit[:, None, None], cov_seen, model.cov))
        fitted = model.fitted | has_fit

    return dataclasses.replace(
        model,
        center=jnp.where(touched[:, None], fused[:, :2], model.center),
        radius=jnp.where(touched, fused[:, 2], model.radius),
        cov=jnp.where(touched[:, None, None], cov, model.cov),
        fitted=jnp.where(touched, fitted, model.fitted),
        times_detected=model.times_detected + touched.astype(jnp.int32),
    )
