"""The training script's parts: labels that follow the picture, and weights that mean the same."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

TOOLS = Path(__file__).parents[1] / "tools" / "reader"
sys.path.insert(0, str(TOOLS))
torch = pytest.importorskip("torch")
pytest.importorskip("onnx")

from augment import example, frame  # noqa: E402
from brackets import draw_braces  # noqa: E402
from export import to_onnx  # noqa: E402
from load import load  # noqa: E402
from network import CHANNELS, HEIGHT, JAW, ON_JAWS, SHAPES, VIEWS, WIDTH, Reader  # noqa: E402
from samples import MIRRORED, UNNUMBERED, UNTOLD, Sample, distance_inside, drawn_tissue  # noqa: E402
from train import collate, crown_means, losses  # noqa: E402
from train_tissue import loss as tissue_loss  # noqa: E402


def sample(numbered: bool = True) -> Sample:
    """Four crowns as rectangles: 11, 21 above 41, 31; each in a grey of its own."""
    teeth = np.zeros((120, 160), np.uint8)
    image = np.full((120, 160, 3), 120, np.uint8)
    for tooth, x, y in ((11, 40, 20), (21, 80, 20), (41, 45, 62), (31, 80, 62)):
        teeth[y : y + 40, x : x + 35] = tooth
        image[y : y + 40, x : x + 35] = 150 + tooth
    numbers = teeth if numbered else np.where(teeth > 0, UNNUMBERED, 0).astype(np.uint8)
    told = np.ones_like(teeth)
    tissue = np.zeros_like(teeth)
    tissue[10:112, 30:125] = 1
    tissue[:, 150:] = UNTOLD
    return Sample("made", image, teeth, numbers, distance_inside(teeth), told, tissue, 0, 0)


def test_mirrored_numbers_are_their_own_inverse() -> None:
    assert (MIRRORED[MIRRORED] == np.arange(256)).all()
    assert MIRRORED[11] == 21 and MIRRORED[48] == 38 and MIRRORED[55] == 65 and MIRRORED[71] == 81
    assert MIRRORED[0] == 0 and MIRRORED[UNNUMBERED] == UNNUMBERED


def test_distance_is_largest_amid_each_crown() -> None:
    inside = sample().inside
    assert inside[40, 57] == 255 and inside[21, 41] < 60 and inside[5, 5] == 0


def test_first_look_fits_the_picture() -> None:
    found = example(sample(), None)
    assert found.image.shape == (3, HEIGHT, WIDTH) and found.tooth.shape == (
        HEIGHT // 2,
        WIDTH // 2,
    )
    assert set(np.unique(found.number)) == {0, 11, 21, 31, 41}
    corner = frame((120, 160)) @ [40, 20, 1] / 2
    column, row = (
        np.argwhere((found.number == 11).any(axis=0))[0, 0],
        np.argwhere((found.number == 11).any(axis=1))[0, 0],
    )
    assert abs(column - corner[0]) <= 1 and abs(row - corner[1]) <= 1


@pytest.mark.parametrize("seed", range(12))
def test_numbers_follow_every_change(seed: int) -> None:
    """Where the patient's left is stays right of its right unless the picture is unnumbered."""
    found = example(sample(), np.random.default_rng(seed))
    if UNNUMBERED in found.number:
        return
    places = {tooth: np.argwhere(found.number == tooth) for tooth in (11, 21)}
    if min(len(p) for p in places.values()) > 20:
        # The greys tell which crown was which before it was mirrored.
        assert places[11][:, 1].mean() < places[21][:, 1].mean()
    assert ((found.tooth > 0.9) <= (found.number > 0)).mean() > 0.99
    assert found.border.max() == 1 or len(np.unique(found.number)) < 3


def test_unknown_numbers_teach_nothing_of_numbers() -> None:
    torch.manual_seed(0)
    net = Reader()
    known, unknown = (collate([example(sample(n), None)]) for n in (True, False))
    answer, kind = net.eval()(known["image"].float())
    parts = [losses(answer, kind, batch) for batch in (known, unknown)]
    assert parts[0]["jaw"] > 0 and not {"jaw", "side", "primary", "position"} & set(parts[1])
    assert torch.isclose(parts[0]["tooth"], parts[1]["tooth"])


def test_a_small_crown_counts_as_much_as_a_large_one() -> None:
    """What is said of a crown is the mean over it, as the reader pools it."""
    batch = collate([example(sample(), None)])
    answer = torch.zeros(1, CHANNELS, HEIGHT // 2, WIDTH // 2)
    for tooth in (11, 21, 31, 41):
        answer[:, JAW][batch["number"] == tooth] = float(tooth)
    means, numbers = crown_means(answer, batch)
    assert sorted(numbers.tolist()) == [11, 21, 31, 41]
    for mean, number in zip(means, numbers, strict=True):
        assert mean[JAW - SHAPES] == pytest.approx(float(number), abs=1e-3)
    batch["crowns"][batch["number"] == 41] = 0  # nothing of it is left
    assert 41 not in crown_means(answer, batch)[1].tolist()


def halved(maps: torch.Tensor) -> torch.Tensor:
    """Every second pixel of pictures and maps [..., H, W]: learning takes much less time."""
    return maps[..., ::2, ::2] if maps.ndim > 2 else maps


def test_a_few_steps_learn_something() -> None:
    torch.manual_seed(0)
    net = Reader((8, 8, 16, 16, 16))
    whole = collate([example(sample(), None), example(sample(), np.random.default_rng(1))])
    batch = {name: halved(values) for name, values in whole.items()}
    optimiser = torch.optim.AdamW(net.parameters(), 3e-3)
    totals = []
    for _ in range(6):
        total = sum(losses(*net(batch["image"].float()), batch).values())
        optimiser.zero_grad()
        total.backward()
        optimiser.step()
        totals.append(total.item())
    assert totals[-1] < 0.9 * totals[0]


def test_opencv_runs_what_torch_learned(tmp_path: Path) -> None:
    """Normalisation folded in and weights in half precision change the answer by little."""
    torch.manual_seed(0)
    net = Reader((8, 16, 16, 16, 32))
    picture = torch.randn(1, 3, HEIGHT, WIDTH)
    for _ in range(3):
        net.train()(picture)  # means and variances that are not 0 and 1
    path = tmp_path / "reader.onnx"
    path.write_bytes(to_onnx(net.eval()).SerializeToString())
    with torch.no_grad():
        answer, kind = net(picture)
    shipped = cv2.dnn.readNetFromONNX(str(path))
    shipped.setInput(picture.numpy())
    maps, views = shipped.forward(["answer", "kind"])
    assert maps.shape == (1, CHANNELS, HEIGHT // 2, WIDTH // 2) and views.shape == (
        1,
        len(VIEWS) + 1,
    )
    assert np.abs(maps - answer.numpy()).max() < 0.02 * np.abs(answer.numpy()).max()
    assert np.abs(views - kind.numpy()).max() < 0.02 * max(1, np.abs(kind.numpy()).max())


def test_weights_come_back_from_the_file_that_ships(tmp_path: Path) -> None:
    """Training can go on from it: it means the same, and is written the same."""
    shipped = TOOLS.parents[1] / "stages" / "teeth" / "reader.onnx"
    net = load(shipped)
    (tmp_path / "again.onnx").write_bytes(to_onnx(net).SerializeToString(deterministic=True))
    picture = torch.randn(1, 3, HEIGHT, WIDTH, generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        expected = net(picture)[0].numpy()
    for file in (shipped, tmp_path / "again.onnx"):
        runs = cv2.dnn.readNetFromONNX(str(file))
        runs.setInput(picture.numpy())
        assert np.abs(runs.forward("answer") - expected).max() < 1e-3


@pytest.mark.parametrize("seed", range(8))
def test_tissue_follows_every_change(seed: int) -> None:
    """Crowns are tooth or gum, and beyond the picture nobody said anything."""
    found = example(sample(), np.random.default_rng(seed))
    assert set(np.unique(found.tissue)) <= {0, 1, UNTOLD}
    assert (found.tissue[found.number > 0] == 1).mean() > 0.99
    assert (found.tissue[found.valid == 0] == UNTOLD).mean() > 0.9
    assert (found.tissue == 1).sum() > (found.number > 0).sum()


def test_tissue_is_drawn_by_polygons_and_crowns() -> None:
    crowns = np.zeros((100, 200), np.uint8)
    crowns[40:60, 90:110] = 3
    entry = {
        "region": [[[0.1, 0.1], [0.9, 0.1], [0.9, 0.9], [0.1, 0.9]]],
        "not": [[[0.4, 0.3], [0.6, 0.3], [0.6, 0.7], [0.4, 0.7]]],
        "unsure": [[[0.8, 0.0], [1.0, 0.0], [1.0, 0.3], [0.8, 0.3]]],
    }
    drawn = drawn_tissue(entry, crowns)
    assert drawn[50, 30] == 1 and drawn[5, 5] == 0 and drawn[5, 190] == drawn[20, 170] == UNTOLD
    assert drawn[35, 100] == 0 and drawn[50, 100] == 1  # a crown in what is something else


def test_tissue_is_learned_without_a_change_to_anything_else() -> None:
    torch.manual_seed(0)
    net = Reader((8, 8, 16, 16, 16)).eval().requires_grad_(False)
    net.tissue.train().requires_grad_(True)
    batch = collate([example(sample(), np.random.default_rng(k)) for k in range(2)])
    image, valid = halved(batch["image"].float()), halved(batch["valid"])
    tissue = halved(
        torch.from_numpy(
            np.stack([example(sample(), np.random.default_rng(k)).tissue for k in range(2)])
        )
    )
    before = net(image)[0].detach()
    optimiser = torch.optim.AdamW(net.tissue.parameters(), 1e-2)
    totals = []
    for _ in range(6):
        total = tissue_loss(net(image)[0][:, ON_JAWS], tissue, valid)
        optimiser.zero_grad()
        total.backward()
        optimiser.step()
        totals.append(total.item())
    assert totals[-1] < 0.8 * totals[0]
    assert torch.equal(net(image)[0][:, :ON_JAWS], before[:, :ON_JAWS])
    nothing = torch.full_like(tissue, UNTOLD)
    assert tissue_loss(before[:, ON_JAWS], nothing, valid) == 0


def test_braces_are_drawn_onto_crowns_and_labels_stay() -> None:
    made = whole_row()
    plain = made.image.copy()
    image = plain.copy()
    draw_braces(image, made, np.array([[1.0, 0, 0], [0, 1.0, 0]]), np.random.default_rng(3))
    changed = (image != plain).any(axis=2)
    assert 0.05 < changed[made.crowns > 0].mean() < 0.9
    # Wires pass between crowns, and hooks end there; nothing is drawn above and below the rows.
    assert not changed[:10].any() and not changed[-10:].any()
    assert (made.crowns == whole_row().crowns).all() and (made.teeth == whole_row().teeth).all()


def test_no_braces_on_photographs_from_above_or_below() -> None:
    made = replace(whole_row(), view=VIEWS.index("upper"))
    image = made.image.copy()
    draw_braces(image, made, np.array([[1.0, 0, 0], [0, 1.0, 0]]), np.random.default_rng(3))
    assert (image == made.image).all()


def test_what_nobody_outlined_is_left_out_wherever_it_goes() -> None:
    plain = sample()
    plain.image[20:60, 120:150] = (250, 30, 30)  # a red tooth without an outline
    told = np.ones_like(plain.told)
    told[20:60, 120:150] = 0
    seen = 0
    for seed in range(12):
        found, whole = (
            example(s, np.random.default_rng(seed)) for s in (replace(plain, told=told), plain)
        )
        left_out = (whole.valid == 1) & (found.valid == 0)
        assert (found.image == whole.image).all() and (found.valid <= whole.valid).all()
        red = (found.image[0] - found.image[1])[::2, ::2]
        if left_out.any():
            seen += 1
            assert red[left_out].mean() > 5 * abs(red[found.valid == 1].mean())
    assert seen > 6


def test_what_is_left_out_counts_in_no_loss_of_outlines() -> None:
    torch.manual_seed(0)
    net = Reader((8, 8, 16, 16, 16)).eval()
    told = np.ones_like(sample().told)
    told[20:60, 120:150] = 0
    batch = collate([example(replace(sample(), told=told), None)])
    answer, kind = net(batch["image"].float())
    other = answer.clone()
    other[:, :SHAPES] += 3 * (batch["valid"] == 0)[:, None] * (batch["number"] == 0)[:, None]
    parts = [losses(a, kind, batch) for a in (answer, other)]
    for name in ("tooth", "inside", "border"):
        assert torch.isclose(parts[0][name], parts[1][name]), name


def whole_row() -> Sample:
    """Six crowns above six, wide enough for brackets."""
    teeth = np.zeros((120, 200), np.uint8)
    for k in range(6):
        x = 10 + 30 * k
        teeth[15:57, x : x + 28] = (13, 12, 11, 21, 22, 23)[k]
        teeth[62:104, x : x + 28] = (43, 42, 41, 31, 32, 33)[k]
    image = np.full((120, 200, 3), 200, np.uint8)
    inside = distance_inside(teeth)
    told = np.ones_like(teeth)
    return Sample("made", image, teeth, teeth, inside, told, np.full_like(told, UNTOLD), 0, 0)
