"""Touring few witnesses: exact dynamic programming over sets of witnesses and gates (Held and Karp)."""

from __future__ import annotations

import numpy as np
from numba import njit


@njit(cache=True)
def _lengths(first, between, owner, witnesses):  # type: ignore[no-untyped-def]
    """(2^n, G) m: the shortest route from the start through one gate of each witness of a set that ends with g."""
    size = owner.size
    table = np.full((1 << witnesses, size), np.inf)
    for g in range(size):
        table[1 << owner[g], g] = first[g]
    for done in range(1, 1 << witnesses):
        for g in range(size):
            here = table[done, g]
            if here == np.inf:
                continue
            for f in range(size):
                bit = 1 << owner[f]
                if done & bit == 0:
                    way = here + between[g, f]
                    if way < table[done | bit, f]:
                        table[done | bit, f] = way
    return table


def shortest_tour(first: np.ndarray, between: np.ndarray, owner: np.ndarray) -> tuple[float, list[int]]:
    """The shortest open route from the start through one gate of each witness: its length (m), and the gates in order.

    first (G,), between (G, G) symmetric: distances, m. owner (G,): witness of each gate, 0 .. n - 1. Work and memory
    grow as 2^n.
    """
    witnesses = int(owner.max()) + 1
    table = _lengths(first, between, owner, witnesses)
    done = (1 << witnesses) - 1
    gate = int(np.argmin(table[done]))
    length = float(table[done, gate])
    order = [gate]
    while True:
        done ^= 1 << int(owner[gate])
        if not done:
            return length, order[::-1]
        gate = int(np.argmin(table[done] + between[gate]))
        order.append(gate)


def work(gates: int, witnesses: int) -> float:
    """About how many steps the table takes."""
    return float(gates) ** 2 * 2.0**witnesses / 4.0
