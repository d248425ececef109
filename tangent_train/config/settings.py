"""Settings of the commands: name, type, default and comment, once.

A class gives Hydra the defaults (`config_name`), validates the composed settings (`validate`),
and feeds ``--help`` and the reference page with its comments. Lines ``# --- … ---`` are headings in
``--help``. Options of groups (``data=…``) are YAML files; their types are those of the class that
they build.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, Self, TypeVar

from hydra.core.config_store import ConfigStore
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import OmegaConf
from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    DirectoryPath,
    Field,
    FilePath,
    NonNegativeInt,
    PositiveFloat,
    PositiveInt,
    ValidationError,
    model_validator,
)
from pydantic.fields import FieldInfo

from tangent_train.errors import DataError, SettingError, wrong_setting
from tangent_train.files import config_folder
from tangent_train.kinds import MOST_ROTATIONS, Align, DepthKind, ScoreKind


def _as_list(value: Any) -> Any:
    return value if value is None or isinstance(value, list | tuple) else [value]


_Item = TypeVar("_Item")
OneOrMore = Annotated[tuple[_Item, ...], BeforeValidator(_as_list)]
"""A list; a single value is a list of it."""


def texts_of_classes(value: Any) -> dict[str, Sequence[str]]:
    """Return the texts of each class by its name; texts of a list or a .txt file are classes."""
    if not isinstance(value, Mapping):
        texts = [*map(str, _as_list(value))]
        if len(texts) == 1 and texts[0].endswith(".txt"):
            lines = Path(texts[0]).read_text(encoding="utf-8").splitlines()
            texts = [*filter(None, map(str.strip, lines))]
        value = {text: text for text in texts}
    if not (value and all(value.values())):
        raise ValueError("a text for each class")
    return {name: _as_list(texts) for name, texts in value.items()}


Prompts = Annotated[Mapping[str, Sequence[str]] | Sequence[str], BeforeValidator(texts_of_classes)]
"""Texts of each class by its name, see `texts_of_classes`."""

Level = Annotated[int, Field(ge=0, le=14)]
Rows = Annotated[int, Field(gt=0, le=2**15)]
ExistingPath = FilePath | DirectoryPath
FieldOfView = Annotated[float, Field(gt=0, lt=180)]
Share = Annotated[float, Field(ge=0, le=1)]
Threshold = Annotated[float, Field(gt=0, lt=1)]
Section = dict[str, Any]
"""Settings of an option of a group."""

_REPLACED = ("callbacks", "logger")
"""Groups of which a resumed run may get another option."""

Views = str | Section | None
Blend = Literal["feather", "nearest"]


class Settings(BaseModel):
    """Base of all settings."""

    model_config = ConfigDict(frozen=True, extra="forbid", use_attribute_docstrings=True)
    not_read: ClassVar[Sequence[str]] = ()
    """Groups and settings, as regular expressions, that the command does not read, although
    experiments may set them. They are refused on the command line and not suggested."""
    not_content: ClassVar[Sequence[str]] = ()
    """Settings that do not change the files in an output folder."""


class NetworkSettings(Settings):
    """Settings of commands that load a network from a file."""

    # --- network ---
    checkpoint: ExistingPath
    """network file, written by tangent-train, tangent-import or tangent-export"""
    trust: OneOrMore[str] = ()
    """your own packages whose classes a checkpoint may use, e.g. my_networks"""


class LabelMapSettings(Settings):
    """Settings of commands that map the classes of a network."""

    # --- classes ---
    label_map: str | Path | None = None
    """map from the network's classes to those of another data set: a name such as
    ade20k_to_stanford2d3ds, or a JSON file; null = same classes"""
    unmapped: Literal["unknown", "never"] = "unknown"
    """pixels whose best class is not in the label map: unknown (label 0, an error in evaluations) |
    never (take the best class in the map)"""


class PromptSettings(LabelMapSettings):
    """Settings of commands that take a network of tangent-import prompts= with other texts."""

    # --- classes ---
    prompts: Prompts | None = None
    """CLIPSeg and SAM 3: other texts that name the classes, as in tangent-import; null = as in the
    checkpoint"""
    threshold: Threshold | None = None
    """CLIPSeg and SAM 3: probability that a class must exceed, else pixels are unknown; null = as
    in the checkpoint"""


class ImageSettings(Settings):
    """Settings of commands that read images and videos."""

    # --- input ---
    every: PositiveInt = 1
    """videos: read every n-th frame"""
    area: tuple[float, float, float, float] | None = None
    """partial panoramas: [west, east, south, north] in degrees; null = GPano tags, or the whole
    sphere"""
    eye: Literal["left", "right"] | None = None
    """stereo panoramas (two pictures above or beside each other): left | right; null = not
    stereo"""


class PredictSettings(PromptSettings, ImageSettings, NetworkSettings):
    """Settings of tangent-predict."""

    not_content = ("output", "report", "shard", "view_batch_size", "compile", "device", "trust")

    # --- input ---
    input: str | Path
    """image or video, folder of them, or pattern, e.g. 'holiday/*.jpg'"""
    projection: Literal["equirectangular", "perspective"] = "equirectangular"
    """equirectangular | perspective (photos)"""
    fov: FieldOfView | None = None
    """photos: horizontal field of view in degrees; null = from EXIF"""
    depth: ExistingPath | None = None
    """folder of depth images named as the inputs, e.g. depth/ of another prediction: for networks
    that need depth, and for the distances of objects"""
    depth_scale: PositiveFloat = 1000
    """units per meter in depth files of whole numbers, read and written"""
    depth_channel: str | None = None
    """OpenEXR files: channel of depth, e.g. ViewLayer.Depth.Z; null = the one called Z, depth,
    depth.Z or depth.V"""

    # --- views ---
    views: Views = None
    """views of panoramas: tangent | horizontal_wide | horizontal | horizontal_economy |
    horizontal_camera | erp | erp_distortion_aware | cubemap, or 'views={option: horizontal, fov:
    110}'; null = those of the checkpoint"""
    levels: OneOrMore[Level] | None = None
    """level s, or several levels of tangent images to average over; null = as in the checkpoint"""
    base_level: int | None = None
    """tangent images of base level b (20·4^b), also for a checkpoint with other views; null = as in
    the checkpoint"""
    fill: Literal["black", "mean", "edge", "reflect"] | None = None
    """color outside a partial panorama: black | mean (color) | edge (nearest pixel) | reflect; null
    = as in training"""
    blend: Blend = "feather"
    """how overlapping views are merged: feather (weighted mean) | nearest (the view with the
    nearest center)"""
    rotations: Annotated[int, Field(ge=1, le=MOST_ROTATIONS)] = 1
    """average over this number of rotations about the vertical"""
    upright: Literal["pose", "auto"] | None = None
    """align with gravity by: pose (tags of the file) | auto (the pose if known, else estimated);
    null = off"""
    max_tilt_deg: Annotated[float, Field(gt=0, le=180)] = 60
    """upright=auto: largest tilt that is searched, in degrees"""
    align: Align | None = None
    """depth: align the views with each other: none | scale | affine | grid (scales that vary within
    a view); null = by the kind of depth"""

    align_across: Literal["frames"] | ExistingPath | None = None
    """depth: bring all panoramas to one scale: frames (of a video, or of a folder in order, each
    near the next) | their poses, in whose unit depth is then (folder of a sparse COLMAP model, JSON
    file of tangent-render poses=, CSV file, or folder of tran.txt and rot.txt); null = each has its
    own"""

    # --- output ---
    output: Path
    """folder for the results"""
    write: OneOrMore[str] | None = None
    """files to write: labels, color, overlay, probabilities (float16); of depth networks: depth,
    color, normals (EXR, PNG), points (PLY); null = all but probabilities, normals and points"""
    mask: OneOrMore[float | ExistingPath] | None = None
    """panoramas: pixels that become unknown (0): below a latitude (-60), black in a PNG file, or in
    a folder of one file per panorama; also several, e.g. [-60,tripod.png]; null = none"""
    mask_classes: OneOrMore[str] | None = None
    """classes that become unknown, e.g. [sky], with mask= the file of a network that predicts them,
    or a folder that tangent-predict wrote (labels/, classes.json); null = none"""
    min_confidence: Share = 0
    """pixels with a lower confidence (0 to 1) become unknown (0)"""
    depth_format: Literal["png", "npy", "exr"] | None = None
    """depth files: png (16 bits) | npy | exr (float32 meters); null = png"""
    points: PositiveInt | None = None
    """write=[points]: largest number of points per image; null = 500000"""
    report: NonNegativeInt = 12
    """images to show in report.html; 0 = no report"""

    # --- performance ---
    shard: str | int | None = None
    """part of the images for this process, e.g. 3/16; null = all"""
    view_batch_size: PositiveInt | None = None
    """views per forward pass; null = as many as have 2^20 pixels"""
    compile: dict[str, Any] | None = None
    """arguments of torch.compile, e.g. {mode: reduce-overhead} for CUDA graphs; {} = its defaults;
    null = do not compile"""
    device: str = "auto"
    """auto | cpu | cuda | cuda:1 | mps"""


class RenderSettings(ImageSettings):
    """Settings of tangent-render."""

    not_content = ("output", "overwrite")

    # --- input ---
    input: str | Path | None = None
    """required without back= or poses=: panorama or video, folder of them, or pattern, e.g.
    'holiday/*.jpg'"""
    depth_channel: str | None = None
    """OpenEXR files: channel to read, e.g. ViewLayer.Depth.Z; null = colors, or with
    interpolation=nearest and for depth the one called Z, depth, depth.Z or depth.V"""
    interpolation: Literal["bilinear", "nearest"] = "bilinear"
    """bilinear | nearest (for labels and depth)"""

    # --- views ---
    views: Views = None
    """views: tangent | horizontal | horizontal_economy | horizontal_wide | cubemap, or
    'views={option: horizontal, fov: 110}'; null = tangent"""
    base_level: int | None = None
    """base level b: 20·4^b tangent images; null = 1"""
    level: Level | None = None
    """level s, the angular resolution; null = from the rows of each panorama"""
    dim: int | None = None
    """side of tangent images in pixels: smaller crops them, larger adds a margin; null = 2^(s−b)"""
    faces: OneOrMore[int] | None = None
    """indices of the views to write, e.g. [0,5]; null = all"""
    rotation: tuple[float, float, float] | None = None
    """rotation of all views together: [yaw,pitch,roll] in degrees; null = none"""

    # --- views in given directions ---
    yaw: OneOrMore[float] | None = None
    """single views instead of tangent images: degrees to the right of the middle, e.g.
    [0,90,180,270]; null = 0"""
    pitch: OneOrMore[float] | None = None
    """single views: degrees above the horizon, one number or as many as yaw; null = 0"""
    roll: OneOrMore[float] | None = None
    """single views: clockwise roll in degrees, one number or as many as yaw; null = 0"""
    fov: FieldOfView | tuple[FieldOfView, FieldOfView] | None = None
    """single views: horizontal field of view in degrees, or [horizontal, vertical]; null = 90"""
    size: PositiveInt | tuple[PositiveInt, PositiveInt] | None = None
    """single views: [width, height] in pixels, or one number; null = by level and fov"""

    # --- output ---
    output: Path
    """folder for the tangent images; with back=, the file of the panorama"""
    overwrite: bool = False
    """true: replace an existing file of poses=, or back= with one panorama"""
    format: Literal["png", "jpg", "webp", "tif", "npy"] = "png"
    """png | jpg | webp | tif | npy"""

    # --- COLMAP ---
    colmap: bool = False
    """true: write one COLMAP project for all panoramas: images, masks and rig_config.json"""
    mask: OneOrMore[float | ExistingPath] | None = None
    """colmap=true or nerfstudio=true: ignored pixels: below a latitude (-60), black in a PNG file,
    or in a folder of one file per panorama; also several, e.g. [-60,tripod.png]; null = none"""
    mask_classes: OneOrMore[str] | None = None
    """ignored classes, e.g. [person], with mask= a folder that tangent-predict wrote (labels/,
    classes.json)"""
    poses: ExistingPath | None = None
    """folder of a sparse COLMAP model, whose poses of panoramas are written as JSON; with
    nerfstudio=true, also the JSON file or other poses"""

    # --- Nerfstudio ---
    nerfstudio: bool = False
    """true: write a project as colmap=true, with transforms.json, z-depth and sparse_pc.ply for
    splats; several panoramas need poses="""
    depth: ExistingPath | None = None
    """nerfstudio=true: folder of distances, as tangent-predict writes (depth/); null = no depth"""
    depth_scale: PositiveFloat = 1000
    """nerfstudio=true: units per meter in depth files of whole numbers"""

    # --- back to panoramas ---
    back: ExistingPath | None = None
    """folder of results on the tangent images of one panorama, or a folder of such folders"""
    cameras: ExistingPath | None = None
    """back=: cameras.json or its folder; null = with the results. poses=: the project; null = two
    folders up"""
    blend: Blend = "feather"
    """back=: how overlapping images are merged: feather (weighted mean) | nearest; labels and depth
    are never averaged"""
    height: Rows | None = None
    """back=: rows of the panorama; null = as the original"""
    kind: Literal["auto", "color", "labels", "depth", "features"] = "auto"
    """back=: kind of the results: auto | color | labels | depth | features"""
    z_depth: bool = False
    """back=: true = convert z-depth to distance from the center"""


class ExportSettings(NetworkSettings):
    """Settings of tangent-export."""

    # --- output ---
    output: Path
    """file: .onnx or .safetensors"""
    overwrite: bool = False
    """true: replace an existing file"""
    image_size: tuple[int, int] | None = None
    """fixed size of the images: [height, width]; null = any size that the network accepts"""
    opset: int | None = None
    """ONNX operator set; null = default of the exporter"""


class ImportSettings(Settings):
    """Settings of tangent-import."""

    # --- network ---
    library: Literal["torchvision", "huggingface", "smp", "onnx"] | None = None
    """required without network=: torchvision | huggingface | smp | onnx"""
    network: Section | None = None
    """an option of configs/network, with your own weights="""
    model: str | Path | None = None
    """name of the network in the library or on the hub, or a folder written by save_pretrained"""
    weights: str | Path | None = None
    """torchvision: DEFAULT, another published name, or a file; network=: a file with a state
    dict"""
    file: ExistingPath | None = None
    """library=onnx: the ONNX file"""
    scores: ScoreKind | None = None
    """output of the network: logits | probabilities | labels; null = recognized from its values"""
    depth: DepthKind | None = None
    """kind of depth that the network predicts: metric_z | metric_distance | canonical_z |
    canonical_inverse | relative_z | relative_depth | relative_disparity | relative_points |
    log_distance; null = from the model (huggingface), else it predicts classes"""
    image_size: Annotated[OneOrMore[PositiveInt], Field(max_length=2)] | None = None
    """fixed image size: [rows,columns] or the side; null = from the model"""

    # --- classes ---
    classes: ExistingPath | None = None
    """JSON list of class names in the order of the outputs (Mask R-CNN: background first); null =
    from the model, or prompts="""
    unknown_classes: OneOrMore[str] = ()
    """classes that mean unknown, e.g. [background]"""
    unknown_wins: bool = True
    """pixels whose best class is one of unknown_classes: true = unknown (label 0) | false = the
    best other class"""
    prompts: Prompts | None = None
    """texts that name the classes, for CLIPSeg and SAM 3 of huggingface: [chair,"picture frame"] |
    {seating: [chair, sofa], window: window} | prompts.txt with a text per line"""
    threshold: Threshold | None = None
    """with prompts=: probability that a class must exceed, else pixels are unknown; Mask R-CNN:
    score that an object must exceed; null = 0.5"""
    things: OneOrMore[str] = ()
    """classes of which the network also returns objects, e.g. [chair,table], or all; for universal
    networks of huggingface (Mask R-CNN and SAM 3 return those of all classes)"""

    # --- photos and views ---
    normalization: str | dict[str, tuple[float, ...]] | None = None
    """imagenet | unit | symmetric | {mean: […], std: […]}; null = from the model"""
    fov: FieldOfView | tuple[FieldOfView, FieldOfView] | None = None
    """field of view in degrees of the photos it was trained on, or [horizontal, vertical]; with it,
    the depth of metric_z networks follows the focal length of a view; null = 60 for predictions on
    photos"""
    views: Views = None
    """views of panoramas: horizontal_wide | horizontal | horizontal_economy | horizontal_camera |
    tangent | erp | erp_distortion_aware | cubemap, or 'views={option: horizontal, fov: 110}'; null
    = horizontal_wide; with levels= or base_level=, tangent"""
    levels: OneOrMore[Level] | None = None
    """level s, or several levels of tangent images; null = from the image size, two for tangent
    images, e.g. [9, 8]"""
    base_level: int | None = None
    """tangent images of base level b (20·4^b); null = the fewest that fit the image size"""

    # --- output ---
    output: Path
    """file to write: .ckpt, or .onnx for library=onnx"""
    overwrite: bool = False
    """true: replace an existing file"""

    @model_validator(mode="after")
    def _check_source(self) -> Self:
        """Refuse settings that name no trained network."""
        if self.library is None and None in (self.network, self.weights):
            expected = "library=torchvision, huggingface, smp or onnx; or network= with weights="
            raise SettingError(
                "library" if self.network is None else "weights",
                found="null",
                expected=f"a trained network: {expected}<its file>",
                remedy=f"Example: {_example('import')}",
            )
        return self


class KeypointSettings(Settings):
    """Settings of tangent-keypoints."""

    # --- input ---
    data: Section | None = None
    """pairs of a data set: synthrooms_pairs | stanford2d3ds_pairs | zind_pairs; unused with left=
    or input="""
    left: ExistingPath | None = None
    """first panorama of your own pair, with right="""
    right: ExistingPath | None = None
    """second panorama of that pair"""
    input: str | Path | None = None
    """folder of your panoramas, or pattern, e.g. 'holiday/*.jpg'"""
    pairing: Literal["consecutive", "all"] = "consecutive"
    """pairs of input=: consecutive (each panorama with the next) | all"""
    max_pairs: PositiveInt | None = None
    """number of pairs to compare, from the first; null = all"""

    # --- views ---
    base_level: OneOrMore[int] = (0, 1, 2)
    """base levels b to compare, e.g. 1 or [0,1]: 20·4^b images each"""
    level: Level | None = None
    """level s, the angular resolution, at most that of the panorama; null = from its rows"""
    margin: NonNegativeInt = 32
    """pixels added around tangent images, so that keypoints at borders are found"""

    # --- matching ---
    ratio: PositiveFloat = 0.8
    """ratio test: largest ratio of the distances to the nearest and the second nearest neighbor; 1
    = off"""
    mutual: bool = True
    """true: mutual nearest neighbors only"""
    max_error_deg: PositiveFloat = 1
    """largest error of a match that fits the two-view geometry, in degrees"""
    controls: bool = True
    """true: also measure the panorama at the tangent images' resolution, a cube map, and a rotated
    right panorama"""
    seed: NonNegativeInt = 0
    """seed of random samples and rotations"""

    # --- output ---
    output: Path
    """folder for the results; the same settings continue interrupted ones"""
    pictures: NonNegativeInt = 2
    """number of pairs whose matches are drawn"""


class RunSettings(Settings):
    """Settings of a run, which experiments may set."""

    # --- run ---
    name: str = "run"
    """name of the folder in runs/"""
    seed: NonNegativeInt = 0
    """seed of initial weights, sample order, choice of views and augmentation"""

    # --- data ---
    data: Section
    """data set; required, unless experiment= chooses it"""

    # --- views ---
    level: Level = 5
    """level s, the angular resolution: panoramas of 2^(s+1) rows"""
    representation: Section
    """views of a panorama that the network receives"""

    # --- network ---
    network: Section | None = None
    """network to train"""

    # --- training ---
    ema: Share | None = None
    """decay of a moving average of the weights, e.g. 0.999, which is evaluated and stored; null =
    off"""
    task: Section
    """segmentation | classification | depth"""
    optimizer: Section | None = None
    """adam | adamw"""
    scheduler: Section | None = None
    """schedule of the learning rate"""
    trainer: Section
    """default | ddp (several processes)"""
    callbacks: Section | None = None
    """early_stopping | model_summary; null = none"""

    # --- output ---
    panels: NonNegativeInt = 6
    """number of test images in panels/ and report.html (segmentation and depth)"""
    validation_images: NonNegativeInt = 4
    """number of validation images sent to loggers that show images (segmentation and depth)"""
    checkpoint_every_n_steps: PositiveInt | None = 500
    """training steps between checkpoints within an epoch; null = at the end of epochs only"""
    logger: Section | None = None
    """csv | tensorboard | wandb | mlflow | many | none"""


class TrainSettings(RunSettings):
    """Settings of tangent-train."""

    # --- run ---
    resume: Path | None = None
    """folder of an interrupted run to continue with its settings"""

    # --- network ---
    init_from: Path | None = None
    """fine-tuning: checkpoint, state dict or safetensors file to start from; null = weights of
    network="""
    trust: OneOrMore[str] = ()
    """your own packages whose classes a checkpoint may use, e.g. my_networks"""


class FilesSettings(RunSettings):
    """Settings of commands that read predictions of any program."""

    # --- predictions of any program ---
    predictions: ExistingPath | None = None
    """folder of predictions of any program, which are scored instead of a network: label maps,
    class scores or distances of panoramas, named as the images"""
    values: str | None = None
    """predictions: values of the classes in label maps: from_1 (0 is unknown) | from_0 | ids (those
    of the data set's own files) | a JSON file as classes.json, also with colors; null = by
    classes.json in the folder, else from_1"""
    files: ExistingPath | None = None
    """predictions: CSV file with the columns image and prediction, a path in the folder; null = by
    the names of files"""
    resample: Literal["nearest", "linear"] | None = None
    """predictions: brings other sizes to that of the labels: nearest | linear (distances); null =
    other sizes are not scored"""
    depth_scale: PositiveFloat = 1000
    """predictions: units per meter in depth files of integers"""
    depth_channel: str | None = None
    """predictions: channel of OpenEXR files; null = as tangent-predict"""

    @model_validator(mode="after")
    def _check_predictions(self) -> Self:
        """Refuse settings that are read with predictions only."""
        if self.predictions is None:
            of_files = {"values", "files", "resample", "depth_scale", "depth_channel"}
            check_read(self, type(self).model_fields.keys() - of_files)
        return self


class EvaluateSettings(PromptSettings, NetworkSettings, FilesSettings):
    """Settings of tangent-evaluate."""

    not_read: ClassVar[Sequence[str]] = (
        *("network", "optimizer", "scheduler", "callbacks", "recipe", "ema"),
        *("checkpoint_every_n_steps", "validation_images", "data.color_jitter"),
        "representation.(faces_per_panorama|mirror|random_rotation)",
        "task.(auxiliary_weight|backbone_lr_factor|frozen|view_batch_size)",
        "task.head.(class_weights|label_smoothing|loss|scale_invariance)",
        "trainer.(accumulate|check|gradient|limit_(train|val)|log|max|min|num_sanity)_.*",
        "trainer.(overfit|reload|sync|val)_.*",
    )

    checkpoint: ExistingPath | None = None  # type: ignore[assignment]
    """network file, written by tangent-train, tangent-import or tangent-export; required without
    predictions="""

    # --- consistency ---
    consistency: NonNegativeInt = 0
    """panoramas: compare predictions for this number of turns about the vertical, and for as many
    random rotations, with the first prediction; 0 = none (8 with input=)"""
    input: str | Path | None = None
    """only consistency, of panoramas without labels, instead of data=: panorama or video, folder of
    them, or pattern, e.g. 'holiday/*.jpg'"""

    # --- views ---
    representation: Section | None = None  # type: ignore[assignment]
    """views of a panorama that the network receives; null = as in the checkpoint"""
    level: Level | None = None  # type: ignore[assignment]
    """level s, the angular resolution; null = as in the checkpoint"""

    @model_validator(mode="after")
    def _check_network(self) -> Self:
        """Refuse an evaluation of nothing."""
        if self.checkpoint is None and self.predictions is None:
            expected = "a network, or predictions=<folder>"
            raise SettingError("checkpoint", found="null", expected=expected)
        return self


class PhotoSettings(Settings):
    """Settings of the photos of a transfer."""

    data: Section | None = None
    """data set of the photos; null needs checkpoint="""
    representation: Section
    """crops of the photos"""


class FineTuningOptimizer(Settings):
    """Changes of the optimizer in fine-tuning."""

    lr: float | None = None
    """learning rate; null = a tenth of optimizer.lr"""


class FineTuningSettings(Settings):
    """Settings of the fine-tuning of a transfer."""

    epochs: OneOrMore[int] = (1, 10)
    """epochs of each fine-tuning: [1, 10] gives P-FT-1, S-FT-1, P-FT-10, S-FT-10; [] = none"""
    optimizer: FineTuningOptimizer = FineTuningOptimizer()
    """changes of optimizer= in fine-tuning"""
    scheduler: Section | None = None
    """schedule of the learning rate in fine-tuning"""


class TransferSettings(LabelMapSettings, RunSettings):
    """Settings of tangent-transfer."""

    # --- run ---
    name: str = "transfer"
    """folder below runs/transfer; the same name continues an interrupted transfer"""
    seeds: OneOrMore[int] | None = None
    """one transfer per seed, e.g. [0, 1, 2]; null = seed"""
    folds: OneOrMore[int] | None = None
    """one transfer per fold, e.g. [1, 2, 3]; null = data.fold, if there are folds"""

    # --- photos ---
    photos: PhotoSettings
    """settings of the photos"""

    # --- views ---
    level: Level = 8
    """level s of the panoramas and of the crops of photos"""

    # --- network ---
    checkpoint: ExistingPath | None = None
    """network trained on photos (P), which is evaluated and fine-tuned; null = train it"""
    trust: OneOrMore[str] = ()
    """your own packages whose classes a checkpoint may use, e.g. my_networks"""

    # --- training ---
    fine_tuning: FineTuningSettings
    """fine-tuning of P on photos (P-FT) and on panoramas (S-FT)"""

    # --- evaluation ---
    compare: OneOrMore[str | Section] = ("erp", "cubemap")
    """further views in which P is evaluated: representations, or settings, e.g. {name: fine,
    option: erp, rows: 1024}"""
    conditions: OneOrMore[str | Section] = ("upright",)
    """conditions of the test: upright, or settings of data, e.g. {name: tilted-45, test_rotation:
    45, upright: auto}"""
    study_levels: OneOrMore[Level] | None = None
    """instead of all other stages, evaluate P on panoramas of these levels, e.g. [5, 6, 7, 8, 9,
    10]; null = off"""
    study_max_rows: Rows = 512
    """study_levels: largest number of rows that are read; finer levels are sampled from these"""


SETTINGS: Mapping[str, type[Settings]] = {
    "train": TrainSettings,
    "evaluate": EvaluateSettings,
    "predict": PredictSettings,
    "import": ImportSettings,
    "export": ExportSettings,
    "render": RenderSettings,
    "transfer": TransferSettings,
    "keypoints": KeypointSettings,
    "prepare": RunSettings,
    "check": FilesSettings,
}
"""Settings by the name of the command."""


def comment_of(field: FieldInfo) -> str:
    """Return the comment of a setting in one line."""
    return " ".join((field.description or "").split())


def config_name(command: str, arguments: Sequence[str]) -> str:
    """Return the name of the config that Hydra composes, after storing what it builds on.

    That is the config of the command, or with ``resume=<run>`` the stored config of the run.

    Args:
        command: Name of the command, e.g. train.
        arguments: Command line after the program's name.

    Raises:
        DataError: The folder to resume is not that of a run.
        SettingError: Another group is typed for a resumed run.
    """
    store = ConfigStore.instance().store
    store("settings", _defaults(SETTINGS[command]))
    typed = [text for text in arguments if text.startswith("resume=") and command == "train"]
    value = OverridesParser.create().parse_override(typed[-1]).value() if typed else None
    run = OmegaConf.create({"resume": value}).resume  # with interpolations
    if run is None:
        return command
    file = Path(str(run), "config.yaml")
    if not file.is_file():
        expected = "the folder of a run, which tangent-train printed"
        raise DataError(file.parent, found="no config.yaml", expected=expected)
    config: Any = OmegaConf.to_container(OmegaConf.load(file))
    names = {text.partition("=")[0] for text in arguments}
    for group in sorted(names - {*_REPLACED}):
        if (config_folder() / group).is_dir():
            expected = f"a single setting, such as data.root=…, or {' or '.join(_REPLACED)}="
            raise SettingError(f"{group}=, when resuming", found="a group", expected=expected)
    replaced = dict.fromkeys(names.intersection(_REPLACED))
    groups = [*({group: None} for group in replaced), {"override hydra/job_logging": "none"}]
    hydra = {"run": {"dir": str(run)}}
    store("resumed", {**config, **replaced, "defaults": ["_self_", *groups], "hydra": hydra})
    return "resumed"


def _defaults(kind: type[Settings]) -> dict[str, Any]:
    """Return the defaults of a command's settings; ``???`` marks those that must be given.

    The groups are left out, because the defaults list of the command chooses their options.
    """
    values: dict[str, Any] = {}
    for name, field in kind.model_fields.items():
        if isinstance(field.annotation, type) and issubclass(field.annotation, Settings):
            values[name] = _defaults(field.annotation)
        elif not (config_folder() / name).is_dir():
            values[name] = "???" if field.is_required() else plain(field.default)
    return values


def check_read(settings: Settings, read: Collection[str]) -> None:
    """Refuse changed settings that nothing reads beside the others.

    Args:
        settings: Settings of a command.
        read: Names of the settings that are read.

    Raises:
        SettingError: Another setting has not its default.
    """
    for name in settings.model_dump(exclude_defaults=True, exclude={*read}):
        default = type(settings).model_fields[name].default
        expected = f"{'null' if default is None else default}: nothing reads it here"
        raise SettingError(name, found=getattr(settings, name), expected=expected)


def plain(value: Any) -> Any:
    """Return the default of a setting as YAML holds it."""
    return [plain(one) for one in value] if isinstance(value, tuple) else value


def validate(command: str, config: Any, needed: Collection[str] = ()) -> Any:
    """Return the settings of a command as an object of its class.

    Args:
        command: Name of the command, e.g. predict.
        config: Settings that Hydra has composed, or a mapping of them.
        needed: Groups that have to be typed, although they have a default.

    Raises:
        SettingError: A setting is missing, unknown, or of another type.
    """
    values: Any = OmegaConf.to_container(OmegaConf.create(config), resolve=True)
    kind = SETTINGS[command]
    given = {name: v for name, v in values.items() if v != "???" and name not in needed}
    try:
        return kind.model_validate(given)
    except ValidationError as error:
        kinds = {".".join(map(str, one["loc"])): one["type"] for one in error.errors()}
        missing = [f"{name}=" for name, wrong in kinds.items() if wrong == "missing"]
        if missing and "extra_forbidden" not in kinds.values():  # it may be meant for a missing one
            text = ", ".join(missing).replace("data=", "data= or experiment=")
            raise SettingError(f"Missing: {text}. Example: {_example(command)}") from error
        known = [one for one in dotted_names(values) if not is_within(one, kind.not_read)]
        raise wrong_setting(error, known) from error


def _example(command: str) -> str:
    """Return the first example in the help of a command."""
    text = (config_folder() / f"{command}.yaml").read_text("utf-8")
    found = re.search(rf"^ +(tangent-{command} .*?)(  |$)", text, re.MULTILINE)
    return found[1] if found else f"tangent-{command} --help"


def missing_groups(command: str) -> list[str]:
    """Return ["data"] if the command line of a run chooses no data set, neither by experiment."""
    is_own = HydraConfig.get().job.config_name == command  # not that of a resumed run or a stage
    chosen = any(is_within(name, ("data", "experiment", "input")) for name in typed_names())
    needs_data = issubclass(SETTINGS[command], RunSettings) and is_own and not chosen
    return ["data"] * needs_data


def typed_settings() -> list[str]:
    """Return the settings on the command line as they were typed, with their interpolations."""
    typed: Any = OmegaConf.to_container(HydraConfig.get().overrides.task, resolve=False)
    return list(typed)


def typed_names() -> list[str]:
    """Return the names of the settings on the command line, such as ``network.widths``."""
    return [text.lstrip("+~").partition("=")[0] for text in typed_settings()]


def is_within(name: str, names: Collection[str]) -> bool:
    """Return True for one of the names, regular expressions, and for a setting of such a group."""
    return any(re.match(rf"{one}([.@/]|$)", name) for one in names)


def dotted_names(section: Any, prefix: str = "") -> Iterator[str]:
    """Yield the full names of settings and sections, such as ``data`` and ``data.root``."""
    if isinstance(section, Mapping):
        for name, value in section.items():
            yield f"{prefix}{name}"
            yield from dotted_names(value, f"{prefix}{name}.")


def refuse_typed(names: Collection[str], expected: str) -> None:
    """Refuse groups and settings on the command line that the command does not read.

    Raises:
        SettingError: One of the names, or a setting of such a group, is typed.
    """
    for typed in typed_names():
        if is_within(typed, names):
            raise SettingError(typed, found="a value", expected=expected)
