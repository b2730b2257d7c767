"""Declaration of a query that the product does not have: scan points within reach of each point."""

import numpy as np
from numpy.typing import NDArray
from solidcloud.schemas.wire.answers import Cost
from solidcloud.schemas.wire.arrays import Positions
from solidcloud.schemas.wire.question_rules import ColumnRules, Merge, Question
from solidcloud.schemas.wire.requests import Length, QuestionRequest


class CountWithinRequest(QuestionRequest, frozen=True):
    """Count the scan points within `reach` of each point. points: (k, 3) float64, world [m]."""

    points: Positions
    reach: Length


class CountWithinAnswers(Cost, frozen=True, eq=False):
    """Answers of `count_within` for k points.

    count: (k,) uint32, number of scan points found within reach.  exact: (k,) bool, all were found.
    """

    verdict: NDArray[np.uint8]
    count: NDArray[np.uint32]
    exact: NDArray[np.bool_]
    outside: NDArray[np.bool_]
    voxels_missing: NDArray[np.uint32]
    node_visits: NDArray[np.uint32]
    point_tests: NDArray[np.uint32]

    def __len__(self) -> int:
        """Return the number of points answered."""
        return len(self.verdict)


COUNT_WITHIN = Question(
    "count_within",
    CountWithinRequest,
    CountWithinAnswers,
    "points",
    {"count": ColumnRules(Merge.SUM), "exact": ColumnRules(Merge.ALL)},
)
