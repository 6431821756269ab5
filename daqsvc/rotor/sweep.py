"""A bank's one compiled call for a block: all observers and both rules, sample by sample.

Loops over the members of a group become vector instructions; what is rare or branches (contact, a
declaration, a lost observer, coupled axes) goes mode by mode. The CUSUM of log-likelihood ratios (Page 1954)
keeps one mode; every other gathers evidence against that one since its own onset. As long as
nothing is declared, all modes are compared with all.

numba's cache on disk looks at the file of a function alone: after a change in `kernels`, `coupled_kernels` or
`observer_batch` this file must be touched, or the cache emptied.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from daqsvc.kernels import njit
from daqsvc.rotor import coupled_kernels
from daqsvc.rotor.kernels import UNDETERMINED, correct, guarded, orbit, predict, predict_rub
from daqsvc.rotor.observer_batch import WIDTH, sections

if TYPE_CHECKING:
    from typing import Any

    import numpy as np
    from numpy.typing import NDArray

    Bytes = NDArray[np.uint8]
    Floats = NDArray[np.float64]
    Observers = NDArray[np.void]
    Pairs = NDArray[np.void]
    Batch = NDArray[np.void]
    Couplings = NDArray[np.void]
    Observer = Any  # one element of Observers: numba makes a record of it
    Group = Any
    Header = Any
    State = tuple[float, float, float, float]


_PATIENCE = 3.0


@njit(cache=True, nogil=True, error_model="numpy")
def gather(group: Group, own: float, lead_limit: float, width: int) -> int:
    """One sample's evidence of a group's modes against the declared one.

    Args:
        group: of `observer_batch.GROUP`; its scores are the sample's.
        own: log-likelihood of the sample under the declared mode.
        lead_limit: the lead of the declared mode counts up to here.
        width: members that there are modes in.

    Returns:
        How many modes have the evidence that it takes to change the decision.
    """
    score, cusum, lead, age, threshold = group.score, group.cusum, group.lead, group.age, group.threshold
    enough = 0
    for i in range(width):
        evidence = cusum[i] + score[i] - own
        gathers = evidence > 0.0
        cusum[i] = evidence if gathers else 0.0
        age[i] = age[i] + 1 if gathers else 0
        led = lead[i] + own - score[i]
        lead[i] = min(lead_limit, led)
        enough += evidence >= threshold[i]
    return enough


@njit(cache=True, nogil=True, error_model="numpy")
def first_verdict(batch: Batch, pairs: Pairs, header: Header) -> int:
    """One sample's evidence of every mode against every other, and what it decides.

    Args:
        batch: memory of the bank; ages go on.
        pairs: ``[M M]`` of `observer_batch.PAIR`; their log-likelihood ratios go on.
        header: of `observer_batch.HEADER`.

    Returns:
        A mode that leads all modes that do not look like it, or -1.
    """
    count = header.modes
    winner = UNDETERMINED
    for i in range(count):
        group, member = batch[i // WIDTH], i % WIDTH
        group.age[member] += 1
        narrowest = math.inf
        for j in range(count):
            if i != j:
                pair = pairs[i * count + j]
                pair.log_ratio = max(
                    0.0, pair.log_ratio + group.score[member] - batch[j // WIDTH].score[j % WIDTH]
                )
                if pair.threshold < math.inf:
                    narrowest = min(narrowest, pair.log_ratio)
        if narrowest >= header.first_threshold and (
            winner == UNDETERMINED
            or pairs[i * count + winner].log_ratio > pairs[winner * count + i].log_ratio
        ):
            winner = i
    return winner


@njit(cache=True, nogil=True, error_model="numpy")
def next_verdict(batch: Batch, pairs: Pairs, header: Header) -> tuple[int, int]:
    """The mode with a threshold of evidence against the declared one, and the one that takes over, or -1.

    A transient passes by the mildest faults, so for a moment several are past their thresholds. The
    one that takes over must lead the rest by the margin. Past three thresholds this is not needed: on a
    machine that lies between two levels neither ever leads. Where many faults are told apart that is not
    enough, and the transient is given time to settle. A mode that looks like the declared one cannot take
    over from it, and one that looks like the leading one does not hold it up.

    Args:
        batch: memory of the bank.
        pairs: ``[M M]`` of `observer_batch.PAIR`.
        header: of `observer_batch.HEADER`.
    """
    count = header.modes
    row = header.decision * count
    winner, best = UNDETERMINED, 0.0
    for j in range(count):
        evidence = batch[j // WIDTH].cusum[j % WIDTH]
        if evidence > best and pairs[row + j].threshold < math.inf:
            winner, best = j, evidence
    if winner == UNDETERMINED or best < pairs[row + winner].threshold:
        return UNDETERMINED, UNDETERMINED
    threshold = pairs[row + winner].threshold
    second = 0.0
    for j in range(count):
        if (
            j != winner
            and pairs[winner * count + j].threshold < math.inf
            and pairs[row + j].threshold < math.inf
        ):
            second = max(second, batch[j // WIDTH].cusum[j % WIDTH])
    if batch[winner // WIDTH].age[winner % WIDTH] < header.settling_wait:
        return winner, UNDETERMINED
    if best - second < header.identity_nats and best < _PATIENCE * threshold:
        return winner, UNDETERMINED
    return winner, winner


@njit(cache=True, nogil=True, error_model="numpy")
def declare(mode: int, batch: Batch, pairs: Pairs, header: Header) -> None:
    """Make a mode the decision: its lead is what it won by, and the evidence starts again.

    Args:
        mode: index of the mode.
        batch: memory of the bank.
        pairs: ``[M M]`` of `observer_batch.PAIR`.
        header: of `observer_batch.HEADER`.
    """
    won = batch[mode // WIDTH].cusum[mode % WIDTH]
    for j in range(header.modes):
        group, member = batch[j // WIDTH], j % WIDTH
        pair = pairs[mode * header.modes + j]
        lead = pair.log_ratio if header.decision == UNDETERMINED else won - group.cusum[member]
        group.lead[member] = min(header.lead_limit, lead)
        group.threshold[member] = pair.threshold
    for g in range(len(batch)):
        batch[g].cusum[:] = 0.0
        batch[g].age[:] = 0
    header.decision = mode


_REGISTER = 4
"""Members are looped over in whole vector registers of this many."""
_DRIFT = -1e3
"""Logarithm of odds from which the paper's are counted from their leader again, to lose no digits."""


@njit(cache=True, nogil=True, error_model="numpy")
def _free(group: Group, member: int) -> State:
    return group.free_x[member], group.free_u[member], group.free_y[member], group.free_v[member]


@njit(cache=True, nogil=True, error_model="numpy")
def _set_free(group: Group, member: int, state: State) -> None:
    group.free_x[member], group.free_u[member], group.free_y[member], group.free_v[member] = state


@njit(cache=True, nogil=True, error_model="numpy")
def _paper(group: Group, member: int) -> State:
    return group.paper_x[member], group.paper_u[member], group.paper_y[member], group.paper_v[member]


@njit(cache=True, nogil=True, error_model="numpy")
def _set_paper(group: Group, member: int, state: State) -> None:
    group.paper_x[member], group.paper_u[member], group.paper_y[member], group.paper_v[member] = state


@njit(cache=True, nogil=True, error_model="numpy")
def _width(group: int, count: int) -> int:
    """Members of a group that have to be computed."""
    return min(WIDTH, (count - group * WIDTH + _REGISTER - 1) // _REGISTER * _REGISTER)


@njit(cache=True, nogil=True, error_model="numpy")
def _forget(observers: Observers, batch: Batch, pairs: Pairs, header: Header) -> None:
    """Forget estimates and evidence; the decision is held.

    Linear observers start on their own orbits, rub observers on the healthy one. The revolution that
    they need to find the machine is no evidence.
    """
    for m in range(len(observers)):
        # NaN means lost: the guard puts a rub observer onto the healthy orbit at once.
        start = math.nan if observers[m].substeps > 0 else 0.0
        _set_free(batch[m // WIDTH], m % WIDTH, (start, start, start, start))
        _set_paper(batch[m // WIDTH], m % WIDTH, (start, start, start, start))
    for g in range(len(batch)):
        batch[g].cusum[:] = 0.0
        batch[g].age[:] = 0
        batch[g].log_odds[:] = batch[g].log_prior
    for p in range(len(pairs)):
        pairs[p].log_ratio = 0.0
    header.departed = 0
    header.paper_age = 0
    header.settling = header.samples_per_rev


@njit(cache=True, nogil=True, error_model="numpy")
def start_anew(memory: Bytes) -> None:
    """Start every observer of a bank again with the next sample that is usable, as after a long gap.

    Args:
        memory: uint8 ``[n]``, see `observer_batch.sections`; changed in place.
    """
    headers, batch, observers, pairs, _ = sections(memory)
    _forget(observers, batch, pairs, headers[0])
    headers[0].unusable = headers[0].samples_per_rev + 1


@njit(cache=True, nogil=True, error_model="numpy")
def _observe(group: Group, x: float, y: float, cos: float, sin: float, width: int) -> None:
    """Innovations of a group's linear observers; the free-running ones are stepped to the next sample.

    Update and prediction are one step of the closed loop, x+ = F (I - K C) x + F K z: it halves the chain
    of operations from a state to the next.
    """
    a, b, rest_x, rest_y = group.a, group.b, group.rest_x, group.rest_y
    xx, xv, vx, vv = group.closed_xx, group.closed_xv, group.closed_vx, group.closed_vv
    drive_x, drive_v, weight, log_norm = group.drive_x, group.drive_v, group.weight, group.log_norm
    free_x, free_u, free_y, free_v = group.free_x, group.free_u, group.free_y, group.free_v
    paper_x, paper_y, z_x, z_y = group.paper_x, group.paper_y, group.z_x, group.z_y
    score, paper_score = group.score, group.paper_score
    for i in range(width):
        zx = x - (a[i] * cos - b[i] * sin + rest_x[i])
        zy = y - (a[i] * sin + b[i] * cos + rest_y[i])
        dx, du, dy, dv = free_x[i], free_u[i], free_y[i], free_v[i]
        ex, ey = zx - dx, zy - dy
        score[i] = weight[i] * (ex * ex + ey * ey) - log_norm[i]
        free_x[i] = xx[i] * dx + (xv[i] * du + drive_x[i] * zx)
        free_u[i] = vx[i] * dx + (vv[i] * du + drive_v[i] * zx)
        free_y[i] = xx[i] * dy + (xv[i] * dv + drive_x[i] * zy)
        free_v[i] = vx[i] * dy + (vv[i] * dv + drive_v[i] * zy)
        ex, ey = zx - paper_x[i], zy - paper_y[i]
        paper_score[i] = weight[i] * (ex * ex + ey * ey) - log_norm[i]
        z_x[i], z_y[i] = zx, zy


@njit(cache=True, nogil=True, error_model="numpy")
def _step_paper(group: Group, width: int) -> None:
    """A group's linear observers under the paper's rule, stepped to the next sample."""
    xx, xv, vx, vv = group.closed_xx, group.closed_xv, group.closed_vx, group.closed_vv
    drive_x, drive_v, z_x, z_y = group.drive_x, group.drive_v, group.z_x, group.z_y
    paper_x, paper_u, paper_y, paper_v = group.paper_x, group.paper_u, group.paper_y, group.paper_v
    for i in range(width):
        dx, du, dy, dv = paper_x[i], paper_u[i], paper_y[i], paper_v[i]
        paper_x[i] = xx[i] * dx + (xv[i] * du + drive_x[i] * z_x[i])
        paper_u[i] = vx[i] * dx + (vv[i] * du + drive_v[i] * z_x[i])
        paper_y[i] = xx[i] * dy + (xv[i] * dv + drive_x[i] * z_y[i])
        paper_v[i] = vx[i] * dy + (vv[i] * dv + drive_v[i] * z_y[i])


@njit(cache=True, nogil=True, error_model="numpy")
def _observe_rub(
    observer: Observer, healthy: Observer, group: Group, member: int, cos: float, sin: float
) -> None:
    """A rub observer with both rules: the free-running one is stepped, the paper's corrected."""
    z_x, z_y = group.z_x[member], group.z_y[member]
    state = guarded(observer, healthy, cos, sin, _free(group, member))
    state, group.score[member] = correct(observer, z_x, z_y, state)
    _set_free(group, member, predict_rub(observer, cos, sin, state))
    state = guarded(observer, healthy, cos, sin, _paper(group, member))
    state, group.paper_score[member] = correct(observer, z_x, z_y, state)
    _set_paper(group, member, state)


@njit(cache=True, nogil=True, error_model="numpy")
def _coast(observers: Observers, batch: Batch, cos: float, sin: float) -> None:
    """Predict all estimates through a sample that is missing."""
    for m in range(len(observers)):
        observer, group, member = observers[m], batch[m // WIDTH], m % WIDTH
        free, paper = _free(group, member), _paper(group, member)
        if observer.substeps > 0:
            free = guarded(observer, observers[0], cos, sin, free)
            paper = guarded(observer, observers[0], cos, sin, paper)
        _set_free(group, member, predict(observer, cos, sin, free))
        _set_paper(group, member, predict(observer, cos, sin, paper))


@njit(cache=True, nogil=True, error_model="numpy")
def _guard_coupled(
    observers: Observers, couplings: Couplings, m: int, cos: float, sin: float, state: State
) -> State:
    """The state of one observer; a rub observer that is lost starts again."""
    if observers[m].substeps == 0:
        return state
    return coupled_kernels.guarded(observers[m], couplings[m], observers[0], couplings[0], cos, sin, state)


@njit(cache=True, nogil=True, error_model="numpy")
def _observe_coupled(
    observers: Observers, couplings: Couplings, batch: Batch, x: float, y: float, cos: float, sin: float
) -> None:
    """Observers with coupled axes under both rules: the free-running are stepped, the paper's corrected."""
    for m in range(len(couplings)):
        observer, coupling, group, member = observers[m], couplings[m], batch[m // WIDTH], m % WIDTH
        ox, _, oy, _ = coupled_kernels.orbit(observer, coupling, cos, sin)
        free = _guard_coupled(observers, couplings, m, cos, sin, _free(group, member))
        free, group.score[member] = coupled_kernels.correct(coupling, x - ox, y - oy, free)
        paper = _guard_coupled(observers, couplings, m, cos, sin, _paper(group, member))
        paper, group.paper_score[member] = coupled_kernels.correct(coupling, x - ox, y - oy, paper)
        if observer.substeps > 0 and not coupled_kernels.touches(coupling, ox + free[0], oy + free[2]):
            group.score[member] = min(group.score[member], batch[0].score[0])
            group.paper_score[member] = min(group.paper_score[member], batch[0].paper_score[0])
        _set_free(group, member, coupled_kernels.predict(observer, coupling, cos, sin, free))
        _set_paper(group, member, paper)


@njit(cache=True, nogil=True, error_model="numpy")
def _step_paper_coupled(
    observers: Observers, couplings: Couplings, batch: Batch, cos: float, sin: float
) -> None:
    """Estimates under the paper's rule, corrected already, stepped to the next sample."""
    for m in range(len(couplings)):
        group, member = batch[m // WIDTH], m % WIDTH
        state = coupled_kernels.predict(observers[m], couplings[m], cos, sin, _paper(group, member))
        _set_paper(group, member, state)


@njit(cache=True, nogil=True, error_model="numpy")
def _coast_coupled(observers: Observers, couplings: Couplings, batch: Batch, cos: float, sin: float) -> None:
    """Predict all estimates through a sample that is missing."""
    for m in range(len(couplings)):
        observer, coupling, group, member = observers[m], couplings[m], batch[m // WIDTH], m % WIDTH
        state = _guard_coupled(observers, couplings, m, cos, sin, _free(group, member))
        _set_free(group, member, coupled_kernels.predict(observer, coupling, cos, sin, state))
        state = _guard_coupled(observers, couplings, m, cos, sin, _paper(group, member))
        _set_paper(group, member, coupled_kernels.predict(observer, coupling, cos, sin, state))


@njit(cache=True, nogil=True, error_model="numpy")
def _hand_over_coupled(
    observers: Observers, couplings: Couplings, batch: Batch, cos: float, sin: float, declared: int
) -> None:
    """As `_hand_over` does: the declared one's estimate for all, stepped."""
    dx, du, dy, dv = _paper(batch[declared // WIDTH], declared % WIDTH)
    ox, ou, oy, ov = coupled_kernels.orbit(observers[declared], couplings[declared], cos, sin)
    for m in range(len(couplings)):
        tx, tu, ty, tv = coupled_kernels.orbit(observers[m], couplings[m], cos, sin)
        state = (dx + ox - tx, du + ou - tu, dy + oy - ty, dv + ov - tv)
        state = coupled_kernels.predict(observers[m], couplings[m], cos, sin, state)
        _set_paper(batch[m // WIDTH], m % WIDTH, state)
    for g in range(len(batch)):
        batch[g].log_odds[:] = batch[g].log_prior


@njit(cache=True, nogil=True, error_model="numpy")
def _decide(batch: Batch, pairs: Pairs, header: Header) -> int:
    """The mode that the CUSUM changes its decision to, with evidence that is enough; or -1."""
    if header.decision == UNDETERMINED:
        header.departed = 0
        return first_verdict(batch, pairs, header)
    suspect, winner = next_verdict(batch, pairs, header)
    departs = suspect != UNDETERMINED and winner == UNDETERMINED
    header.departed = header.departed + 1 if departs else 0
    return winner


@njit(cache=True, nogil=True, error_model="numpy")
def _believe_group(group: Group, top: float, bar: float, width: int) -> tuple[int, int]:
    """Add one sample's evidence; how many modes are within the bar of the leader, and how many above it."""
    log_odds, paper_score = group.log_odds, group.paper_score
    near, above = 0, 0
    for i in range(width):
        odds = log_odds[i] + paper_score[i]
        log_odds[i] = odds
        near += odds > top - bar
        above += odds > top
    return near, above


@njit(cache=True, nogil=True, error_model="numpy")
def _believe(batch: Batch, count: int, header: Header) -> int:
    """The mode that passes the paper's threshold, or -1."""
    leader = header.paper_leader
    top = batch[leader // WIDTH].log_odds[leader % WIDTH]
    for m in range(count):
        if batch[m // WIDTH].log_odds[m % WIDTH] > top:
            leader, top = m, batch[m // WIDTH].log_odds[m % WIDTH]
    total = 0.0
    for m in range(count):
        total += math.exp(batch[m // WIDTH].log_odds[m % WIDTH] - top)
    if top < _DRIFT:
        for g in range(len(batch)):
            batch[g].log_odds[:] -= top
    header.paper_leader = leader
    return leader if total < header.largest_total else UNDETERMINED


@njit(cache=True, nogil=True, error_model="numpy")
def _hand_over(observers: Observers, batch: Batch, cos: float, sin: float, declared: int) -> None:
    """Every observer under the paper's rule takes over the declared one's estimate, and is stepped."""
    observer, group, member = observers[declared], batch[declared // WIDTH], declared % WIDTH
    dx, du, dy, dv = _paper(group, member)
    if observer.substeps == 0:
        (dx, du, dy, dv), _ = correct(observer, group.z_x[member], group.z_y[member], (dx, du, dy, dv))
    ox, ou, oy, ov = orbit(observer, cos, sin)
    for m in range(len(observers)):
        tx, tu, ty, tv = orbit(observers[m], cos, sin)
        state = (dx + ox - tx, du + ou - tu, dy + oy - ty, dv + ov - tv)
        _set_paper(batch[m // WIDTH], m % WIDTH, predict(observers[m], cos, sin, state))
    for g in range(len(batch)):
        batch[g].log_odds[:] = batch[g].log_prior


@njit(cache=True, nogil=True, error_model="numpy")
def advance(  # noqa: C901, PLR0912, PLR0915 - one recursion: correct, weigh, declare, predict
    xy: Floats, cos: Floats, sin: Floats, begin: int, memory: Bytes
) -> int:
    """Run a bank over a block, up to the next change of its decision.

    Both rules run side by side, each over its own estimates. The paper's (section V): conditional
    probabilities, declared at a threshold; then every observer takes over the declared one's estimate,
    and the probabilities go back to their priors. Without the hand-over the observers that lost never
    learn that the machine has changed.

    Args:
        xy: float64 ``[n, 2]``, measured position in clearances; farther out than can be, or NaN: missing.
        cos: float64 ``[n]``, cosine of the shaft angle; NaN: not known.
        sin: float64 ``[n]``, its sine.
        begin: sample to begin at; not 0 to go on with a block after a change.
        memory: uint8 ``[n]``, the bank's, see `observer_batch.sections`; changed in place.

    Returns:
        ``-1 - k`` if the decision changed at sample k, which is taken in; else n.
    """
    headers, batch, observers, pairs, couplings = sections(memory)
    header, count, coupled = headers[0], len(observers), len(couplings) > 0
    if begin == 0:
        header.paper_declarations = 0
    for k in range(begin, len(xy)):
        x, y, c, s = xy[k, 0], xy[k, 1], cos[k], sin[k]
        usable = x * x + y * y < header.usable_squared and math.isfinite(c + s)
        if usable:
            if header.unusable > header.samples_per_rev:
                _forget(observers, batch, pairs, header)
            header.unusable = 0
            if coupled:
                _observe_coupled(observers, couplings, batch, x, y, c, s)
            else:
                for g in range(len(batch)):
                    _observe(batch[g], x, y, c, s, _width(g, count))
                for r in range(header.rubs):
                    m = batch[r // WIDTH].rub[r % WIDTH]
                    _observe_rub(observers[m], observers[0], batch[m // WIDTH], m % WIDTH, c, s)
        else:
            header.unusable += 1
            if coupled:
                _coast_coupled(observers, couplings, batch, c, s)
            else:
                _coast(observers, batch, c, s)
        counts = usable and header.settling == 0
        header.settling = max(0, header.settling - 1)
        if not counts:
            for g in range(len(batch)):
                batch[g].score[:] = 0.0

        previous, paper_previous = header.decision, header.paper_decision
        enough = int(previous == UNDETERMINED)
        if previous != UNDETERMINED:
            own = batch[previous // WIDTH].score[previous % WIDTH]
            for g in range(len(batch)):
                enough += gather(batch[g], own, header.lead_limit, _width(g, count))
        winner, onset = UNDETERMINED, 0
        if enough:
            winner = _decide(batch, pairs, header)
        else:
            header.departed = 0
        if winner != UNDETERMINED:
            onset = k + 1 - batch[winner // WIDTH].age[winner % WIDTH]
            declare(winner, batch, pairs, header)

        declared = UNDETERMINED
        if counts:
            group, member = batch[header.paper_leader // WIDTH], header.paper_leader % WIDTH
            top = group.log_odds[member] + group.paper_score[member]
            near, above = 0, 0
            for g in range(len(batch)):
                more = _believe_group(batch[g], top, header.odds_bar, _width(g, count))
                near, above = near + more[0], above + more[1]
            # One other mode close to the leader keeps it below the threshold: no need for exponentials.
            if above or near <= 1 or top < _DRIFT:
                declared = _believe(batch, count, header)
        header.paper_age += 1
        paper_onset = k + 1 - header.paper_age
        if declared != UNDETERMINED:
            header.paper_declarations += 1
            header.paper_decision = declared
            header.paper_age = 0
            if coupled:
                _hand_over_coupled(observers, couplings, batch, c, s, declared)
            else:
                _hand_over(observers, batch, c, s, declared)
        elif usable and coupled:
            _step_paper_coupled(observers, couplings, batch, c, s)
        elif usable:
            for g in range(len(batch)):
                _step_paper(batch[g], _width(g, count))
            for r in range(header.rubs):
                m = batch[r // WIDTH].rub[r % WIDTH]
                group, member = batch[m // WIDTH], m % WIDTH
                _set_paper(group, member, predict_rub(observers[m], c, s, _paper(group, member)))

        if header.by_paper and declared not in (UNDETERMINED, paper_previous):
            header.changed_from, header.changed_onset = paper_previous, paper_onset
            return -1 - k
        if not header.by_paper and winner != UNDETERMINED:
            header.changed_from, header.changed_onset = previous, onset
            return -1 - k
    return len(xy)
