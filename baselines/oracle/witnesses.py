"""Touring witnesses: the linear program behind the lower bound.

A witness is a checkpoint; its gates are the pieces of the border of its viewer region. A route from outside that sees
the checkpoint crosses one of them. What is asked here: the shortest open route from the start through one gate of
every witness, over given smallest distances between gates (see `baselines.oracle.lower` for where they come from).

Integer programme. x_pq in {0, 1}: gates p and q of different witnesses follow each other; y_p: gate p is the one taken
of its witness; a_p, z_p: the route begins and ends with p.

    min  sum d_pq x_pq + sum d_p a_p
    a_p + z_p + sum_q x_pq = 2 y_p            for each gate                                                  (1)
    sum of y over a witness's gates = 1       for each witness                                               (2)
    sum a = 1,  sum z = 1                                                                                    (3)
    x(E(S)) <= y(S) - 1                       for each set S of gates that holds all gates of some witness   (4)

Every open route satisfies these: within S it is a set of paths, so it has fewer edges than gates there, and it has
some gate there. Dropping integrality and all but some of (4) can only lower the minimum. The value returned is not the
solver's: it is the Lagrangian bound of the solver's row prices, summed up over all columns, whether the solver was
given them or not, so neither its tolerances nor its choice of columns matter. (For the generalised travelling salesman
see Fischetti, Salazar Gonzalez and Toth 1997.)
"""

from __future__ import annotations

from dataclasses import dataclass

import highspy
import numpy as np
from scipy.cluster.hierarchy import linkage
from scipy.sparse import csr_array
from scipy.sparse.csgraph import breadth_first_order, maximum_flow

_SCALE = 1_000_000
_VIOLATED = 0.02
"""A cut is added if it is violated by this much."""
_PRICE = 1e-7
_IDLE = 3
"""A cut that had no price in so many solutions goes."""
_PRICE_EVERY = 3
"""Columns are priced after so many rounds of cuts; in between, the solution of the smaller problem will do."""


@dataclass
class Cuts:
    """Rows (4): the sets S by gates (k, P) bool, and for how many solutions each has had no price (k,)."""

    inside: np.ndarray
    idle: np.ndarray

    @classmethod
    def none(cls, gates: int) -> Cuts:
        return cls(np.zeros((0, gates), bool), np.zeros(0, int))

    def added(self, inside: np.ndarray) -> Cuts:
        return Cuts(np.vstack([self.inside, inside]), np.append(self.idle, np.zeros(len(inside), int)))

    def regrouped(self, parent: np.ndarray, between: np.ndarray) -> Cuts:
        """For other gates, each a part of an old one (its index) or new (-1); cuts long without price go.

        A new gate joins the sets of the gate that is nearest by between (P, P): any set is valid, and this one cuts.
        """
        kept = self.idle < _IDLE
        fresh = parent < 0
        inside = self.inside[kept][:, np.where(fresh, 0, parent)] & ~fresh
        if fresh.any() and not fresh.all():
            old = np.flatnonzero(~fresh)
            inside[:, fresh] = inside[:, old[np.argmin(between[np.ix_(fresh, old)], axis=1)]]
        return Cuts(inside, self.idle[kept])


@dataclass
class Solution:
    """What the linear program says."""

    bound: float
    """No route through one gate of each witness is shorter, m."""
    cuts: Cuts
    taken: np.ndarray
    """(P,) share to which each gate is taken, y."""
    pairs: np.ndarray
    """(k, 2) gates that follow each other in part; -1 for the start."""
    shares: np.ndarray
    """(k,) by how much."""
    work: float
    """Simplex iterations times the size of the tableau."""
    columns: np.ndarray
    """(m, 2) pairs of gates that may matter: to begin with when the gates change."""


class Tour:
    """The program over fixed gates, with columns and cuts added as they are needed."""

    def __init__(
        self, owner: np.ndarray, first: np.ndarray, between: np.ndarray, cuts: Cuts, columns: np.ndarray
    ) -> None:
        """owner (P,): witness of each gate, 0 .. n - 1; first (P,), between (P, P): smallest distances, m, finite."""
        self.owner, self.first, self.between, self.cuts = owner, first, between, cuts
        self.size, self.witnesses = len(owner), int(owner.max()) + 1
        self._same = owner[:, None] == owner[None]
        if not len(cuts.inside) and self.witnesses > 2:
            self.cuts = cuts.added(self._nested())
        self._known = np.eye(self.size, dtype=bool) | self._same
        self._pairs = np.zeros((0, 2), np.int64)
        self._solver = highspy.Highs()
        for name, value in (("output_flag", False), ("threads", 1), ("presolve", "off"), ("random_seed", 0)):
            self._solver.setOptionValue(name, value)
        self._work = 0.0
        self._build()
        self._add_columns(np.vstack([columns, self._nearest(4), self._greedy()]))

    def _build(self) -> None:
        """Rows (1) to (3), then cuts; columns y, a, z."""
        p, n = self.size, self.witnesses
        for _ in range(p):
            self._solver.addRow(0.0, 0.0, 0, np.zeros(0, np.int32), np.zeros(0))
        for _ in range(n + 2):
            self._solver.addRow(1.0, 1.0, 0, np.zeros(0, np.int32), np.zeros(0))
        gates = np.arange(p)
        one = np.ones(p)
        self._columns(np.zeros(p), [(gates, -2.0 * one), (p + self.owner, one)])
        self._columns(self.first, [(gates, one), (np.full(p, p + n), one)])
        self._columns(np.zeros(p), [(gates, one), (np.full(p, p + n + 1), one)])
        self._rows_of(self.cuts.inside)

    def _columns(self, costs: np.ndarray, entries: list[tuple[np.ndarray, np.ndarray]]) -> None:
        """Columns of the same number of entries each, >= 0."""
        count, height = len(costs), len(entries)
        rows = np.stack([e[0] for e in entries], axis=1).astype(np.int32).ravel()
        values = np.stack([e[1] for e in entries], axis=1).astype(np.float64).ravel()
        starts = np.arange(count, dtype=np.int32) * height
        self._solver.addCols(count, costs, np.zeros(count), np.full(count, np.inf), len(rows), starts, rows, values)

    def _rows_of(self, inside: np.ndarray) -> None:
        for s in inside:
            pairs = np.flatnonzero(s[self._pairs[:, 0]] & s[self._pairs[:, 1]])
            columns = np.concatenate([np.flatnonzero(s), 3 * self.size + pairs]).astype(np.int32)
            values = np.concatenate([-np.ones(int(s.sum())), np.ones(len(pairs))])
            self._solver.addRow(-np.inf, -1.0, len(columns), columns, values)

    def _add_columns(self, pairs: np.ndarray) -> int:
        """Put pairs (k, 2) of gates into the program, those that are not yet in it."""
        pairs = np.sort(pairs, axis=1)
        pairs = np.unique(pairs[~self._known[pairs[:, 0], pairs[:, 1]]], axis=0)
        if not len(pairs):
            return 0
        p, q = pairs.T
        self._known[p, q] = self._known[q, p] = True
        held = self.cuts.inside[:, p] & self.cuts.inside[:, q]
        column, cut = np.nonzero(held.T)
        rows = np.concatenate([p, q, self.size + self.witnesses + 2 + cut])
        index = np.concatenate([np.arange(len(p)), np.arange(len(p)), column])
        order = np.lexsort((rows, index))
        starts = np.searchsorted(index[order], np.arange(len(p))).astype(np.int32)
        rows = rows[order].astype(np.int32)
        zeros, costs = np.zeros(len(p)), self.between[p, q]
        self._solver.addCols(len(p), costs, zeros, np.full(len(p), np.inf), len(rows), starts, rows, np.ones(len(rows)))
        self._pairs = np.vstack([self._pairs, pairs])
        return len(pairs)

    def _nested(self) -> np.ndarray:
        """Sets to begin with (k, P): witnesses that are near to each other, by single linkage."""
        n = self.witnesses
        apart = np.full((n, n), np.inf)
        np.minimum.at(apart, (self.owner[:, None], self.owner[None]), self.between)
        members = [np.arange(n) == w for w in range(n)]
        for a, b, _, _ in linkage(apart[np.triu_indices(n, 1)], "single"):
            members.append(members[int(a)] | members[int(b)])
        return np.array(members[n:])[:, self.owner]

    def _nearest(self, count: int) -> np.ndarray:
        """Each gate with its nearest gates of other witnesses."""
        far = np.where(self._same, np.inf, self.between)
        count = min(count, self.size - 1)
        near = np.argpartition(far, count, axis=1)[:, : count + 1]
        pairs = np.stack([np.repeat(np.arange(self.size), near.shape[1]), near.ravel()], axis=1)
        return pairs[~self._same[pairs[:, 0], pairs[:, 1]]]

    def _greedy(self) -> np.ndarray:
        """The pairs of some route, so that the program has a solution: always to the nearest gate of a new witness."""
        done = np.zeros(self.witnesses, bool)
        at = int(np.argmin(self.first))
        pairs: list[tuple[int, int]] = []
        while True:
            done[self.owner[at]] = True
            if done.all():
                return np.array(pairs, np.int64).reshape(-1, 2)
            following = int(np.argmin(np.where(done[self.owner], np.inf, self.between[at])))
            pairs.append((at, following))
            at = following

    def solve(self, rounds: int, effort: float) -> Solution:
        """Solve, cut and price in turn; at most so many rounds of cuts, and none after so much work."""
        best = -np.inf
        priced = True
        for turn in range(rounds + 1):
            y, x, prices = self._optimum(priced)
            if priced:
                best = max(best, self._bound(prices)[0])
                if turn == rounds or self._work > effort:
                    break
            more = self._cut(y, x)
            if not more and priced:
                break
            priced = not more or turn % _PRICE_EVERY == 0 or turn + 1 == rounds or self._work > effort
        base = len(self.owner) * 3
        used = np.flatnonzero(x > 1e-6)
        values = np.array(self._solver.getSolution().col_value)
        begin = np.flatnonzero(values[self.size : 2 * self.size] > 1e-6)
        pairs = np.vstack([self._pairs[used], np.stack([np.full(len(begin), -1), begin], axis=1)])
        shares = np.concatenate([x[used], values[self.size + begin]])
        assert len(values) == base + len(self._pairs)
        reduced = self._bound(prices)[1]
        p, q = np.nonzero(np.triu(reduced < 0.02, 1) & ~self._same)
        return Solution(best, self.cuts, y, pairs, shares, self._work, np.stack([p, q], axis=1))

    def _optimum(self, price: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """y (P,), x of the columns, and the rows' prices, when no column is left that would pay."""
        while True:
            self._solver.run()
            solution = self._solver.getSolution()
            prices = np.array(solution.row_dual)
            iterations = max(0, self._solver.getInfo().simplex_iteration_count)
            self._work += iterations * (len(prices) + len(solution.col_value))
            values = np.array(solution.col_value)
            if not price:
                return values[: self.size], values[3 * self.size :], prices
            _, reduced = self._bound(prices)
            missing = np.where(self._known, 0.0, reduced)
            p, q = np.nonzero(np.triu(missing < -_PRICE, 1))
            if len(p) > 3 * self.size:
                least = np.argpartition(missing[p, q], 3 * self.size)[: 3 * self.size]
                p, q = p[least], q[least]
            if not self._add_columns(np.stack([p, q], axis=1)):
                return values[: self.size], values[3 * self.size :], prices

    def _bound(self, prices: np.ndarray) -> tuple[float, np.ndarray]:
        """The Lagrangian bound of row prices, and the reduced costs (P, P) of all pairs.

        A route takes one gate of each witness, one first and one last gate, and n - 1 pairs: columns that the prices
        make negative are counted as often as that.
        """
        p, n = self.size, self.witnesses
        gate, witness, (begin, end), cut = prices[:p], prices[p : p + n], prices[p + n : p + n + 2], prices[p + n + 2 :]
        cut = np.minimum(cut, 0.0)
        active = cut < 0.0
        inside = csr_array(self.cuts.inside[active].astype(np.float64))
        weight = cut[active]
        reduced = self.between - gate[:, None] - gate[None] - (inside.T @ (inside * weight[:, None])).toarray()
        taken = 2.0 * gate - witness[self.owner] + inside.T @ weight
        least = np.full(n, np.inf)
        np.minimum.at(least, self.owner, taken)
        bound = witness.sum() + begin + end - cut.sum() + least.sum()
        bound += min(self.first - gate - begin) + min(-gate - end)
        bound += (n - 1) * min(0.0, float(np.where(self._same, 0.0, reduced).min()))
        self.cuts.idle[active] = 0
        return float(bound), reduced

    def _cut(self, y: np.ndarray, x: np.ndarray) -> bool:
        """Add violated rows (4), found as smallest cuts of the support; whether there were any."""
        prices = np.array(self._solver.getSolution().row_dual)[self.size + self.witnesses + 2 :]
        self.cuts.idle[np.abs(prices) < 1e-9] += 1
        values = np.array(self._solver.getSolution().col_value)
        used = np.flatnonzero(y > 1e-6)
        name = np.full(self.size, -1)
        name[used] = np.arange(len(used)) + 1  # 0: start and end together
        support = np.flatnonzero(x > 1e-6)
        tails, heads = name[self._pairs[support, 0]], name[self._pairs[support, 1]]
        ok = (tails > 0) & (heads > 0)
        home = values[self.size + used] + values[2 * self.size + used]
        tails = np.concatenate([tails[ok], np.zeros(len(used), np.int64)])
        heads = np.concatenate([heads[ok], np.arange(len(used)) + 1])
        capacity = np.rint(np.concatenate([x[support][ok], home]) * _SCALE).astype(np.int64)
        some = capacity > 0
        graph = tails[some], heads[some], capacity[some]
        # A gate that is not in use goes with the nearest that is: else the next solution only moves beside the cut.
        near = self.between[:, used]
        kin = used[np.argmin(near, axis=1)]
        kin[used] = used
        inside: list[np.ndarray] = []
        found: set[bytes] = set()
        for w in range(self.witnesses):
            flow, side = _smallest_cut(len(used) + 1, graph, name[used[self.owner[used] == w]])
            if flow > (2.0 - _VIOLATED) * _SCALE:
                continue
            s = np.zeros(self.size, bool)
            s[used[side[side > 0] - 1]] = True
            s = s[kin]
            s[self.owner == w] = True
            key = np.packbits(s).tobytes()
            if key not in found:
                found.add(key)
                inside.append(s)
        if not inside:
            return False
        self._rows_of(np.array(inside))
        self.cuts = self.cuts.added(np.array(inside))
        return True


def _smallest_cut(
    nodes: int, graph: tuple[np.ndarray, np.ndarray, np.ndarray], sinks: np.ndarray
) -> tuple[int, np.ndarray]:
    """Flow from node 0 to the sinks over edges (tails, heads, capacity), and what the cut nearest to them holds."""
    tails, heads, capacity = graph
    drain = np.full(len(sinks), nodes)
    entries = np.concatenate([capacity, capacity, np.full(len(sinks), 4 * _SCALE)]).astype(np.int32)
    where = np.concatenate([tails, heads, sinks]), np.concatenate([heads, tails, drain])
    matrix = csr_array((entries, where), shape=(nodes + 1, nodes + 1))
    result = maximum_flow(matrix, 0, nodes)
    left = csr_array((matrix - result.flow).T)  # what can still flow, backwards
    left.eliminate_zeros()
    side = breadth_first_order(left, nodes, return_predecessors=False)
    return int(result.flow_value), side[side < nodes]
