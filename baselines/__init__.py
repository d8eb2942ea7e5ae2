"""Policies to compare with: `make_policy("nearest")`; the names are in `policy_names()`."""

from baselines.registry import make_policy, policy_names

__all__ = ["make_policy", "policy_names"]
