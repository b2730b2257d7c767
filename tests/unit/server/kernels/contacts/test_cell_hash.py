"""The hash of grid cells: how cells that lie side by side are spread over a table."""

import numpy as np
import pytest
from solidcloud.server.kernels.contacts.contact_cells import find_slot, make_cells
from solidcloud.server.runtime.stop_flag import NO_STOP

pytestmark = pytest.mark.interpreted


def test_cells_near_each_other_do_not_crowd() -> None:
    """Touched cells lie side by side: 4,096 of a block, and as many of a plane, in a table of 16,384 slots."""
    cells = make_cells(8192, NO_STOP.flag)
    blocks = np.indices((16, 16, 16)).reshape(3, -1).T, np.indices((64, 64, 1)).reshape(3, -1).T
    for block in blocks:
        for corner in ([0, 0, 0], [-70_000, 5, 1_000_000]):
            homes = [int(find_slot(cells, *place)) for place in (block + corner).tolist()]
            taken = len(set(homes))
            # Slots drawn at random: 16384 (1 - (1 - 1/16384)^4096) = 3,624.
            assert taken > 3300
            assert min(homes) < 100 and max(homes) > len(cells.slots) - 100
