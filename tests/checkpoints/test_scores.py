"""Scores of the classes of any network."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor, nn

from tangent_train.checkpoints.kinds import ScoreKind
from tangent_train.checkpoints.scores import ClassScoreNetwork, as_logits
from tangent_train.errors import SettingError


class LabelMaps(nn.Module):
    """A network that returns the class of a pixel, which is its red channel, and no scores."""

    def forward(self, images: Tensor) -> Tensor:
        return images[:, 0]


@pytest.mark.parametrize(
    ("num_classes", "groups", "message"),
    [(4, None, "found 4, for 5 scores"), (6, None, "6, for 5"), (1, [[5]], "1, for 5")],
)
def test_other_numbers_of_names_than_of_scores_are_refused(
    num_classes: int, groups: list[list[int]] | None, message: str
) -> None:
    with pytest.raises(SettingError, match=message):
        ClassScoreNetwork(nn.Conv2d(3, 5, 1), num_classes, groups)(torch.zeros(1, 3, 2, 2))


def test_label_maps_are_certain() -> None:
    """Other values are in the last group."""
    images = torch.tensor([0.0, 2.0, 1.0, -1.0, 3.0, 255.0, torch.nan]).expand(1, 3, 2, 7)
    scores = ClassScoreNetwork(LabelMaps(), 3, [[0], [1], [2], [3]], kind="labels")(images)
    assert scores.argmax(dim=1).tolist() == [[[0, 2, 1, 3, 3, 3, 3]] * 2]
    assert float(scores.softmax(dim=1).amax(dim=1).min()) > 0.999


@pytest.mark.parametrize("kind", ["logits", "probabilities"])
def test_a_single_score_is_that_of_a_sigmoid(kind: ScoreKind) -> None:
    logits = torch.linspace(-3, 3, 6).reshape(1, 1, 2, 3)
    returned = logits.sigmoid() if kind == "probabilities" else logits
    found = as_logits(returned, kind, 1).softmax(dim=1)
    torch.testing.assert_close(found[:, :1], logits.sigmoid())


@pytest.mark.parametrize("size", [(4, 6), (5, 6), (11, 13)])
def test_larger_images_are_divided(size: tuple[int, int]) -> None:
    """A network of single pixels: dividing changes nothing, and every part has the right size."""
    network, images = nn.Conv2d(3, 2, 1), torch.randn(2, 3, *size)
    expected, seen = network(images), []
    network.register_forward_pre_hook(lambda _, given: seen.append(given[0].shape[-2:]))
    with torch.no_grad():
        found = ClassScoreNetwork(network, 2, tile=(4, 6))(images)
    torch.testing.assert_close(found, expected.detach())
    assert set(seen) == {(4, 6)}
    assert len(seen) == -(-size[0] // 4) * -(-size[1] // 6)
