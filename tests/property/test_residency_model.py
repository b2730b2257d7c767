"""Compare the voxel cache with a model, for holds and background loads in any order: promised voxels are resident, and
the budget holds."""

from contextlib import AbstractContextManager
from typing import NamedTuple

import pytest
from fake_store import BLOCK, FakeStore
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule
from solidcloud.server.residency.voxel_cache import BackgroundLoad, HeldVoxels, VoxelCache

SIZES = [1, 1, 2, 3, 1, 4, 2, 1, 5, 2]  # cache lines
BUDGET = 9
ROWS = st.lists(st.integers(0, len(SIZES) - 1), unique=True, max_size=4)


class WouldWaitError(Exception):
    """A request would wait for room: in one thread, for ever."""


def _refuse(*_: object) -> None:
    raise WouldWaitError


class Holding(NamedTuple):
    """A hold that is open, and what it was promised."""

    context: AbstractContextManager[HeldVoxels]
    rows: list[int]
    good: set[int]


class ResidencyMachine(RuleBasedStateMachine):
    """Holds are opened and closed in any order; rows become corrupt or unreadable and mend.

    The model: which rows have been found corrupt, which have failed for those who hold them now, and the holds.
    """

    def __init__(self) -> None:
        super().__init__()
        self.store = FakeStore(SIZES)
        self.residency = VoxelCache(self.store, BUDGET * BLOCK)
        self.residency.on_owed = lambda: None
        self.residency._changed.wait = _refuse  # type: ignore[method-assign,assignment]
        self.open: list[Holding] = []
        self.corrupt: set[int] = set()
        self.failed: set[int] = set()
        self.asked = 0

    def _held(self) -> set[int]:
        return {row for holding in self.open for row in holding.rows}

    @rule(rows=ROWS)
    def hold(self, rows: list[int]) -> None:
        """Open a hold, where the rows fit the budget at all."""
        if sum(SIZES[row] for row in rows) > BUDGET:
            with pytest.raises(ValueError, match="ask in pieces"), self.residency.hold(rows):
                pass
            return
        before = {row for row in range(len(SIZES)) if self.residency.where[row, 0] >= 0}
        loads = self.store.loads.copy()
        before_bad = self.corrupt | self.failed
        context = self.residency.hold(rows)
        try:
            held = context.__enter__()
        except WouldWaitError:
            # Only what others hold may be in the way.
            assert self._held()
            assert self.store.loads == loads
            return
        self.asked += len(rows) - len([row for row in rows if row in before_bad])
        missing = {row for row in rows if row not in before} - self.corrupt - self.failed
        loaded = self.store.loads - loads
        # One load of each that was not there. One that was is loaded anew only to make room in one run of what lies
        # in pieces, and that only while nobody else holds anything.
        assert set(loaded.values()) <= {1} and missing <= set(loaded)
        assert set(loaded) == missing or (set(loaded) <= set(rows) and not self._held())
        self.corrupt |= {row for row in loaded if self.store.faults.get(row) == "corrupt"}
        self.failed |= {row for row in loaded if self.store.faults.get(row) == "unreadable"}
        bad = [row for row in rows if row in self.corrupt | self.failed]
        faulty = len([row for row in rows if row in before_bad])  # neither there nor loaded again
        assert (held.hits, held.misses) == (len(rows) - len(loaded) - faulty, len(loaded))
        assert len(held.faults) == len(bad)
        assert all(f"voxel {row}" in fault for row, fault in zip(bad, held.faults, strict=True))
        self.open.append(Holding(context, rows, set(rows) - set(bad)))

    @rule(rows=ROWS)
    def stand(self, rows: list[int]) -> None:
        """Users stand in these now."""
        self.residency.kept = frozenset(rows)

    @rule(row=st.integers(0, len(SIZES) - 1), sooner=ROWS, owed=st.booleans())
    def load_in_background(self, row: int, sooner: list[int], owed: bool) -> None:
        """Load a voxel that nobody waits for, others being wanted sooner: none of those goes, nor what is stood in."""
        before = {other for other in range(len(SIZES)) if self.residency.where[other, 0] >= 0}
        loads = self.store.loads[row]
        found = self.residency.load_in_background(row, lambda other: other not in sooner, owed=owed)
        after = {other for other in range(len(SIZES)) if self.residency.where[other, 0] >= 0}
        stays = before & (set(sooner) | self.residency.kept | self._held())
        assert stays <= after <= before | {row}
        fault = self.store.faults.get(row)
        bad = row in self.corrupt | (self.failed & self._held())
        assert self.store.loads[row] - loads == (
            found is not BackgroundLoad.NO_ROOM and not bad and row not in before
        )
        assert (found is BackgroundLoad.RESIDENT) == (row in after)
        if self.store.loads[row] > loads and fault == "corrupt":
            self.corrupt.add(row)
        elif self.store.loads[row] > loads and fault and row in self._held():
            self.failed.add(row)
        if found is BackgroundLoad.NO_ROOM:
            free = BUDGET - sum(SIZES[other] for other in stays)
            assert free < SIZES[row] or self._held() or stays, "there was room"

    @rule()
    def pay(self) -> None:
        """What is owed is asked for by somebody once, and not there."""
        row = self.residency.take_owed()
        assert row is None or self.residency.where[row, 0] == -1

    @precondition(lambda self: self.open)
    @rule(data=st.data())
    def leave(self, data: st.DataObject) -> None:
        """Close any of the holds."""
        self.open.pop(data.draw(st.integers(0, len(self.open) - 1))).context.__exit__(None, None, None)
        self.failed &= self._held()

    @rule(row=st.integers(0, len(SIZES) - 1), fault=st.sampled_from(["corrupt", "unreadable", ""]))
    def damage(self, row: int, fault: str) -> None:
        """Change how the next load of a row ends."""
        self.store.faults.pop(row, None)
        if fault:
            self.store.faults[row] = fault

    @invariant()
    def all_is_as_promised(self) -> None:
        """What is held is there and whole; the bytes add up and stay within the budget."""
        self.residency.check()
        assert self.residency.resident_bytes <= BUDGET * BLOCK
        assert self.residency.stats.hits + self.residency.stats.misses == self.asked
        for holding in self.open:
            for row in holding.good:
                first = int(self.residency.where[row, 0])
                run = self.residency.buffer.arena.ints[first : first + SIZES[row] * BLOCK // 4]
                assert first >= 0 and (run == row).all(), "evicted or overwritten while held"
            for row in set(holding.rows) - holding.good:
                assert self.residency.where[row, 0] == -1, (
                    "became resident under a hold that began without it"
                )


TestResidency = ResidencyMachine.TestCase
TestResidency.settings = settings(max_examples=80, stateful_step_count=40, deadline=None, derandomize=True)
