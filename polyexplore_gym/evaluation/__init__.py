"""Comparing policies: episodes, results on disk, statistics, tables and plots.

study = Study(policies=name_policies(["nearest", "my.module:MyPolicy"]), plans=suite("home-test").plans())
records = evaluate(study, out="results/mine", workers=4)
print(summary_text(summarize(records, np.random.default_rng(0))))
"""

from polyexplore_gym.evaluation.bounds import Bounds, find_bounds, read_bounds, write_bounds
from polyexplore_gym.evaluation.episode import run_episode
from polyexplore_gym.evaluation.policy import Policy, PolicySpec, load_policy
from polyexplore_gym.evaluation.records import EpisodeRecord
from polyexplore_gym.evaluation.results import read_manifest, read_records
from polyexplore_gym.evaluation.runner import Study, evaluate, name_policies
from polyexplore_gym.evaluation.setting import Setting
from polyexplore_gym.evaluation.summary import Summary, summarize
from polyexplore_gym.evaluation.tables import summary_text, write_tables

__all__ = [
    "Bounds",
    "EpisodeRecord",
    "Policy",
    "PolicySpec",
    "Setting",
    "Study",
    "Summary",
    "evaluate",
    "find_bounds",
    "load_policy",
    "name_policies",
    "read_bounds",
    "read_manifest",
    "read_records",
    "run_episode",
    "summarize",
    "summary_text",
    "write_bounds",
    "write_tables",
]
