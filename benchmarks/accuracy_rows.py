"""The rows of ``python -m benchmarks accuracy``: what is trained, and how else it is evaluated."""

from __future__ import annotations

import difflib
from typing import TYPE_CHECKING, NamedTuple

from tangent_train.errors import SettingError

if TYPE_CHECKING:
    from collections.abc import Sequence

__all__ = ["EXPERIMENT", "ORIENTATIONS", "PLAIN", "ROWS", "Row", "Variant", "chosen_rows"]

EXPERIMENT = "experiment=rooms/accuracy"
"""What all rows begin with."""

ORIENTATIONS = {"null": "upright", "20": "20°", "45": "45°", "90": "90°", "so3": "SO(3)"}
"""How test panoramas are turned: values of ``data.test_rotation``, and what tables call them."""


class Variant(NamedTuple):
    """A way to evaluate a network that is trained.

    Attributes:
        name: Short.
        settings: Overrides for the evaluation.
        orientations: Those of `ORIENTATIONS` it is tested in.
        told_up: Whether it is told what a camera alone does not know: where up is.
    """

    name: str
    settings: tuple[str, ...] = ()
    orientations: tuple[str, ...] = tuple(ORIENTATIONS)
    told_up: bool = False

    @property
    def upright(self) -> bool:
        """Whether panoramas are looked at upright, however the camera was held."""
        return any(text.startswith("data.upright=") for text in self.settings)


PLAIN = Variant("plain")
"""As the network was trained."""

_NEAREST = Variant("blend nearest", ("representation.blend=nearest",), ("null",))
_AVERAGED = Variant("4 turned icosahedra", ("representation.average_rotations=4",), ("null", "so3"))
_EIGHT = Variant("8 turned icosahedra", ("representation.average_rotations=8",), ("null", "so3"))
_AUTO = Variant("upright=auto", ("data.upright=auto", "data.max_tilt_deg=60"), ("null", "20", "45"))
_AUTO_ANY = Variant("upright=auto, any tilt", ("data.upright=auto", "data.max_tilt_deg=180"))
_AUTO_SO3 = _AUTO_ANY._replace(orientations=("null", "so3"))
_AVERAGED_AUTO = Variant(
    "4 turned icosahedra, upright=auto, any tilt",
    (*_AVERAGED.settings, *_AUTO_SO3.settings),
    ("null", "so3"),
)
_POSE = Variant("upright=pose", ("data.upright=pose",), ("45", "so3"), told_up=True)


class Row(NamedTuple):
    """A network that is trained, all others for the same time.

    Attributes:
        name: Short, for ``--rows`` and folders.
        about: What it is.
        settings: Overrides of `EXPERIMENT`.
        variants: How it is evaluated besides `PLAIN`.
    """

    name: str
    about: str
    settings: tuple[str, ...] = ()
    variants: tuple[Variant, ...] = ()

    @property
    def equirect(self) -> bool:
        """Whether it is one of the baselines without tangent images."""
        return any(text.startswith("representation=erp") for text in self.settings)

    @property
    def turned(self) -> bool:
        """Whether it is trained on panoramas turned any way."""
        return _SO3 in self.settings


_SO3 = "representation.rotation=so3"
_AUX = "network=unet_small_aux"
_CONTEXT = "network=unet_small_context"
_ELEVATION = "data.inputs=[rgb,depth,elevation]"
_ERP = ("representation=erp", "data.panoramas_per_step=2")
_CROPS = ("representation=erp_crops", "data.panoramas_per_step=16")
_WHOLE = (
    "representation=tangent",
    "representation.rotation=yaw",
    "representation.mirror=true",
    "data.panoramas_per_step=2",
)
_ALL_FACES = ("representation.faces_per_panorama=null", "data.panoramas_per_step=2")
_TEN = ("representation.faces_per_panorama=10", "data.panoramas_per_step=4")
_THREE = ("representation.faces_per_panorama=3", "data.panoramas_per_step=13")
_WIDE = (
    "representation.crop_multiple=null",
    "representation.dim=80",
    "representation.faces_per_panorama=2",
)
_WIDER = (
    "representation.crop_multiple=null",
    "representation.dim=96",
    "representation.faces_per_panorama=1",
    "data.panoramas_per_step=10",
)
_ALL = (_CONTEXT, "data.inputs=[rgb,depth,validity,elevation]", "ema=0.999")
_GRAVITY = (_AUTO, _POSE)
_ANY_GRAVITY = (_AUTO_ANY, _POSE)
_BEST = (_AVERAGED, *_GRAVITY)
_ALL_WAYS = (_AVERAGED, _EIGHT, *_GRAVITY, _AUTO_SO3, _AVERAGED_AUTO)

_EQUIRECT = (
    Row("erp", "whole equirectangular images, 2 a step", _ERP),
    Row("erp_aux", "the same with an auxiliary head", (*_ERP, _AUX)),
    Row("erp_crops", "90° wide crops of equirectangular images, 16 a step", _CROPS),
    Row(
        "erp_crops_aux", "the same with an auxiliary head", (*_CROPS, _AUX), (*_GRAVITY, _AUTO_SO3)
    ),
)
_PIXELS = (
    Row("tangent", "all 20 tangent images of 2 panoramas, not cropped, not blended", _WHOLE),
    Row("crop", "all 20, cropped to the owned cells, blended", _ALL_FACES),
    Row("few", "5 of 20, of 8 panoramas", (), (_NEAREST, *_BEST)),
    Row("few_10", "10 of 20, of 4 panoramas", _TEN),
)
_ADDITIONS = (
    Row("few_aux", "few, with an auxiliary head", (_AUX,), _BEST),
    Row("few_elevation", "few, shown how far up every pixel looks", (_ELEVATION,), _GRAVITY),
    Row("few_validity", "few, shown where depth is missing", ("data.inputs=[rgb,depth,validity]",)),
    Row("few_attention", "few_aux, whose images see each other", (_CONTEXT,), _BEST),
    Row(
        "few_attention_alone",
        "the same without the loss of the auxiliary head",
        (_CONTEXT, "task.auxiliary_weight=0"),
    ),
    Row("few_3_aux", "3 of 20, of 13 panoramas, with an auxiliary head", (*_THREE, _AUX), _BEST),
    Row(
        "few_3_elevation",
        "few_3_aux, shown how far up every pixel looks",
        (*_THREE, _AUX, _ELEVATION),
        _ALL_WAYS,
    ),
    Row(
        "wide_aux",
        "2 of 20, 80² wide, of 8 panoramas, with an auxiliary head",
        (*_WIDE, _AUX),
        _BEST,
    ),
    Row(
        "wide_elevation",
        "wide_aux, shown how far up every pixel looks",
        (*_WIDE, _AUX, _ELEVATION),
        _BEST,
    ),
    Row(
        "wider_elevation", "1 of 20, 96² wide, of 10 panoramas", (*_WIDER, _AUX, _ELEVATION), _BEST
    ),
    Row("few_10_aux", "few_10, with an auxiliary head", (*_TEN, _AUX)),
    Row("few_10_attention", "few_10_aux, whose images see each other", (*_TEN, _CONTEXT)),
    Row(
        "few_sphere_rendering",
        "few_aux, with features rendered to a coarse sphere and back",
        ("network=unet_small_sphere_rendering",),
    ),
)
_LOSSES = (
    Row("few_none", "few, classes not weighted", ("task.class_weights=none",)),
    Row("few_log", "few, the paper's class weights", ("task.class_weights=log",)),
    Row("few_effective", "few, effective numbers of pixels", ("task.class_weights=effective",)),
    Row("few_lovasz", "few, Lovász's loss beside cross-entropy", ("task.region_loss=lovasz",)),
    Row("few_dice", "few, Dice's loss beside cross-entropy", ("task.region_loss=dice",)),
    Row("few_ema", "few, the average of the weights", ("ema=0.999",)),
    Row("few_cosine", "few, the cosine schedule", ("scheduler=cosine",)),
    Row("all", "few with attention, elevation, validity and averaged weights", _ALL, _BEST),
)
_TURNED = (
    Row("erp_so3", "erp, turned any way in training", (*_ERP, _SO3), _ANY_GRAVITY),
    Row("erp_aux_so3", "erp_aux, likewise", (*_ERP, _AUX, _SO3)),
    Row("erp_crops_aux_so3", "erp_crops_aux, likewise", (*_CROPS, _AUX, _SO3), _ANY_GRAVITY),
    Row("few_so3", "few, likewise", (_SO3,), (_AVERAGED, *_ANY_GRAVITY)),
    Row("few_aux_so3", "few_aux, likewise", (_AUX, _SO3), (_AVERAGED,)),
    Row(
        "few_attention_so3",
        "few_attention, likewise",
        (_CONTEXT, _SO3),
        (_AVERAGED, _EIGHT, *_ANY_GRAVITY),
    ),
    Row(
        "few_10_attention_so3", "few_10_attention, likewise", (*_TEN, _CONTEXT, _SO3), (_AVERAGED,)
    ),
)

ROWS: dict[str, Row] = {
    row.name: row for row in (*_EQUIRECT, *_PIXELS, *_ADDITIONS, *_LOSSES, *_TURNED)
}
"""All of them, in the order of the table, by name."""


def chosen_rows(names: Sequence[str]) -> list[Row]:
    """The rows of these names, in the order of the table; of none, all.

    Raises:
        SettingError: There is no such row.
    """
    for name in names:
        if name not in ROWS:
            near = difflib.get_close_matches(name, ROWS, n=3, cutoff=0.6)
            raise SettingError(
                "--rows",
                found=f"'{name}'",
                expected=", ".join(ROWS),
                remedy=f"Did you mean {' or '.join(near)}?" if near else "",
            )
    return [row for row in ROWS.values() if not names or row.name in names]
