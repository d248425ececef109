"""Names that settings may have, and errors about others."""

from __future__ import annotations

import pytest

from tangent_train.errors import SettingError
from tangent_train.registry import check_registered, import_named


@pytest.mark.parametrize(
    ("target", "remedy"),
    [
        ("no_such_package.Net", "Install its package"),
        ("torch.nn.Convolution", r"Correct the name\."),
        ("models.Missing", r"Correct the name, or add it to models/__init__\.py\."),
    ],
)
def test_names_that_cannot_be_imported_are_told_apart(target: str, remedy: str) -> None:
    with pytest.raises(SettingError, match=rf"network\._target_: found {target}, .*{remedy}"):
        import_named(target, "network")


def test_classes_that_no_checkpoint_may_name_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    class Forgotten:
        pass

    monkeypatch.setattr("models.unet.Forgotten", Forgotten, raising=False)
    monkeypatch.setattr("models.Forgotten", Forgotten, raising=False)
    put, named = "Put @registered above class Forgotten.", "Name it models.{}, and list it"
    for target, remedy in (
        ("models.unet.Forgotten", f"{put} {named.format('Forgotten')}"),
        ("models.Forgotten", put),
        ("models.unet.UNet", named.format("UNet")),
    ):
        with pytest.raises(SettingError) as refused:
            check_registered(target, "network")
        assert refused.value.remedy.startswith(remedy)
    for target in ("models.UNet", "datamodules.SynthRooms", "torch.nn.Conv2d", "my_networks.Net"):
        check_registered(target, "network")
