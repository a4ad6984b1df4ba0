from dataclasses import replace

import numpy as np
import pytest
import torch
from conftest import boxes_of, random_maps, stack

from marl_pack import bins as state
from marl_pack.backend import Backend
from marl_pack.geometry import ORIENTATIONS, oriented


def test_a_box_raises_its_footprint_and_counts_the_gap_below_it() -> None:
    # Seen from the front: a 2-wide box of height 3, bridged by a 4-wide one.
    #   z=3 . B B B B
    #   z=0 . A A . .
    bins = stack((6, 1, 8), (1, 0, 0, 2, 1, 3), (1, 0, 3, 4, 1, 2))
    assert bins.heightmap[0, :, 0].tolist() == [0, 5, 5, 5, 5, 0]
    assert bins.empty_map[0, :, 0].tolist() == [0, 0, 0, 3, 3, 0]
    assert int(bins.filled) == 6 + 8
    assert float(state.utilization(bins)) == pytest.approx(14 / 48)
    assert bins.loads[0, 1].tolist() == [8, 3.0, 0.5]


def test_gaps_under_gaps_add_up() -> None:
    bins = stack((5, 1, 9), (0, 0, 0, 1, 1, 2), (0, 0, 2, 3, 1, 1), (2, 0, 3, 3, 1, 1))
    assert bins.empty_map[0, :, 0].tolist() == [0, 2, 2, 3, 3]


def test_place_returns_resting_height_and_waste() -> None:
    bins = stack((6, 6, 9), (0, 0, 0, 3, 3, 4))
    rest, waste, volume = state.place(
        bins, torch.tensor([[4, 2, 1]], dtype=torch.int16), torch.tensor([[1, 2]])
    )
    assert int(rest) == 4
    assert int(volume) == 8
    assert int(waste) == 8 * 4 - 2 * 4  # 8 columns, of which x = 1, 2 at y = 2 are filled


def test_heightmap_minus_empty_map_counts_the_cells_of_the_boxes() -> None:
    bins = random_maps(32, (7, 5, 12), (1, 4), 20, seed=0)
    for i in range(32):
        filled = np.zeros((7, 5), int)
        for x, y, _, w, d, h in boxes_of(bins, i):
            filled[x : x + w, y : y + d] += h
        assert (bins.heightmap[i].numpy() - bins.empty_map[i].numpy() == filled).all()
        assert int(bins.filled[i]) == filled.sum()


@pytest.mark.parametrize("backend", Backend)
@pytest.mark.parametrize("sides", [(0, 0, 0), (3, 2, 0), (0, 3, 2)])
def test_a_zero_sided_box_changes_nothing(sides: tuple[int, int, int], backend: Backend) -> None:
    bins = replace(stack((4, 4, 4), (0, 0, 0, 2, 2, 2)), backend=backend)
    before = bins.clone()
    state.place(bins, torch.tensor([sides], dtype=torch.int16), torch.tensor([[0, 0]]))
    for now, then in zip(bins.tensors(), before.tensors(), strict=True):
        assert torch.equal(now, then)


@pytest.mark.parametrize("backend", Backend)
def test_labels_are_stored_with_the_boxes_and_unknown_by_default(backend: Backend) -> None:
    bins = state.empty(2, (4, 4, 9), max_boxes=2, backend=backend)
    boxes = torch.tensor([[2, 2, 1], [1, 3, 2]], dtype=torch.int16)
    state.place(
        bins,
        boxes,
        torch.tensor([[0, 0], [1, 1]]),
        labels=(torch.tensor([7, 8]), torch.tensor([3, 0])),
    )
    state.place(bins, boxes, torch.tensor([[2, 2], [0, 0]]))
    assert bins.labels.tolist() == [[[7, 3], [-1, -1]], [[8, 0], [-1, -1]]]
    assert bins.for_boxes(5).labels.shape == (2, 5, 2)
    assert torch.equal(bins[torch.tensor([1])].labels, bins.labels[1:])


def test_a_view_of_other_bins_has_the_same_backend() -> None:
    bins = state.empty(3, (4, 4, 9), max_boxes=2, backend=Backend.TENSOR)
    for other in (bins[:2], bins.clone(), bins.to("cpu"), bins.for_boxes(9)):
        assert other.backend is Backend.TENSOR
    assert state.empty(1, (4, 4, 9)).backend is Backend.COMPILED


def test_orientations_are_the_six_permutations_in_rotated_pairs() -> None:
    assert len(set(ORIENTATIONS)) == 6
    assert ORIENTATIONS[0] == (0, 1, 2)
    for o, (a, b, c) in enumerate(ORIENTATIONS):
        assert ORIENTATIONS[o ^ 1] == (b, a, c)
        assert c == 2 - o // 2
    assert oriented(torch.tensor([3, 4, 5]))[2].tolist() == [3, 5, 4]


@pytest.mark.parametrize("size", [(0, 5, 5), (5, 5), (5, 5.5, 5), (5, 5, 16384)])
def test_an_impossible_bin_is_refused(size: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match=r"bin (size|height)"):
        state.empty(1, size)


@pytest.mark.parametrize("which", [[1, 4], [False, True, False, False, True, False]])
def test_cleared_bins_are_empty_and_the_others_untouched(which: list[int] | list[bool]) -> None:
    bins = random_maps(6, (5, 5, 9), (1, 4), 6, seed=3)
    before = bins.clone()
    state.clear(bins, torch.tensor(which))
    others = torch.tensor([0, 2, 3, 5])
    for name in ("heightmap", "empty_map", "count", "filled"):
        assert getattr(before, name)[[1, 4]].any(), name
        assert not getattr(bins, name)[[1, 4]].any(), name
    for now, then in zip(bins[others].tensors(), before[others].tensors(), strict=True):
        assert torch.equal(now, then)


@pytest.mark.parametrize("backend", Backend)
def test_a_full_bin_and_a_box_outside_are_refused(backend: Backend) -> None:
    bins = state.empty(1, (2, 2, 9), max_boxes=1, backend=backend)
    box = torch.tensor([[1, 1, 1]], dtype=torch.int16)
    state.place(bins, box, torch.tensor([[0, 0]]))
    with pytest.raises(ValueError, match="full"):
        state.place(bins, box, torch.tensor([[0, 0]]))
    for corner, depth in (((-1, 0), 1), ((0, -1), 1), ((2, 0), 1), ((1, 1), 2)):
        bins = state.empty(1, (2, 2, 9), backend=backend)
        with pytest.raises(ValueError, match="out of the map"):
            wide = torch.tensor([[1, depth, 1]], dtype=torch.int16)
            state.place(bins, wide, torch.tensor([corner]))
        assert not bins.heightmap.any()
