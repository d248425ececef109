"""Chart of docs/results/transfer.md from its tables: ``python -m studies.transfer``."""

from __future__ import annotations

import csv
import re
from pathlib import Path

from matplotlib.figure import Figure

from tangent_train.results.chart import COLORS

DATA = Path(__file__).parents[1] / "docs" / "results" / "data"
STAGES = {
    "P": "photos",
    "P-FT-1": "photos, fine-tuned for 1 epoch",
    "P-FT-10": "photos, fine-tuned for 10 epochs",
    "S-erp": "panoramas, equirectangular images",
    "S-cubemap": "panoramas, cube maps",
    "S": "panoramas, tangent images",
    "S-FT-1": "tangent images, fine-tuned for 1 epoch",
    "S-FT-10": "tangent images, fine-tuned for 10 epochs",
}
"""Names of the stages of a transfer, in the order of the chart."""


def table(name: str) -> list[dict[str, str]]:
    """Return the rows of a table of docs/results/data."""
    with (DATA / f"{name}.csv").open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def picture() -> Figure:
    """Plot the mIoU of all stages, and that of panoramas by latitude."""
    figure = Figure((13, 4.6), layout="constrained")
    means, bands = figure.subplots(1, 2, width_ratios=(1, 1.1))
    of_panoramas = [stage for stage in STAGES if stage[0] == "S"]
    colors = dict(zip(of_panoramas, COLORS, strict=False))
    scores = {row["stage"]: row["mIoU"].split(" ± ") for row in table("transfer")}
    for stage, name in reversed(STAGES.items()):
        mean, spread = map(float, scores[stage])
        color = colors.get(stage, COLORS[-1])
        means.barh(name, mean, xerr=spread, color=color, error_kw={"capsize": 3})
        means.annotate(f"{mean:.1f}", (1, name), va="center", color="white", fontweight="bold")
    means.set(xlabel="mIoU %, ± standard deviation over three seeds", xlim=(0, 62))
    lines = table("transfer_latitude")
    ends = [[float(k) for k in re.findall(r"-?\d+", row["latitude"])] for row in lines]
    middles = [sum(pair) / 2 for pair in ends]
    for stage in of_panoramas:
        values = [float(row[stage]) for row in lines]
        bands.plot(middles, values, color=colors[stage], marker="o", ms=4, label=STAGES[stage])
    bands.set(xlabel="latitude", ylabel="mIoU %", xlim=(-90, 90), ylim=(0, 72))
    bands.set_xticks(range(-90, 91, 30), [f"{k}°" for k in range(-90, 91, 30)])
    handles, names = bands.get_legend_handles_labels()
    bands.legend(handles[::-1], names[::-1], frameon=False, fontsize=9, loc="lower right")
    for axes in (means, bands):
        axes.spines[["top", "right"]].set_visible(False)
    return figure


if __name__ == "__main__":
    Path("figures").mkdir(exist_ok=True)
    picture().savefig("figures/transfer.png", dpi=110)
