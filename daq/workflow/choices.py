"""Choices of the operator and their defaults;
imports nothing, so that the help of a verb loads no numerics.
"""

from __future__ import annotations

from enum import Enum

LARGEST_CONDITION = 3500.0
"""Condition of the weighted observation matrix;
the paper's trajectories have 1930 to 2817 (Table 5).
"""
LARGEST_CONDITION_OF_CHAIN = 1e5
"""The same of a closed chain: links that hardly turn have parameters that hardly show,
and spoil no gain.
"""
#: Predicted standard deviation of the worst gain; a plan above it is not worth executing
LARGEST_STD_PERCENT = 10.0
EXCHANGES = 3000  #: Changes of the random moves that the planner tries


class Known(Enum):
    """Parameters of a mounted payload that the fit takes as exact (n_kL of eq. 5)."""

    NOTHING = "nothing"
    MASS = "mass"
    CAD = "cad"
