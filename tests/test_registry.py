"""Names that settings may have, and errors about others."""

from __future__ import annotations

import pytest

from tangent_train.errors import SettingError
from tangent_train.registry import import_named


@pytest.mark.parametrize(
    ("target", "remedy"),
    [
        ("no_such_package.Net", "Install its package"),
        ("torch.nn.Convolution", r"Correct the name\."),
    ],
)
def test_names_that_cannot_be_imported_are_told_apart(target: str, remedy: str) -> None:
    with pytest.raises(SettingError, match=rf"network\._target_: found {target}, .*{remedy}"):
        import_named(target, "network")
