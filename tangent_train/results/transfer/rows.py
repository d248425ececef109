"""Runs alike but for fold and seed, and the row that they are compared with."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from statistics import fmean
from typing import Generic, Protocol, Self, TypeVar

from tangent_train.errors import DataError
from tangent_train.results.reports.groups import Figure, average
from tangent_train.results.reports.runs import Run

__all__ = ["Averages", "Result", "check_once", "sort_key"]


class Result(Protocol):
    """A run with the fold and the seed that it counts for."""

    @property
    def fold(self) -> int | None:
        """The fold it was tested on; None for data without folds."""

    @property
    def seed(self) -> int:
        """Of its network's first training."""

    @property
    def run(self) -> Run:
        """Its figures and settings."""


R_co = TypeVar("R_co", bound=Result, covariant=True)


@dataclass(frozen=True)
class Averages(Generic[R_co]):
    """Figures over folds and seeds.

    Attributes:
        results: Sorted by fold and seed.
        partner: What they are compared with; None where there is nothing.
    """

    results: tuple[R_co, ...]
    partner: Self | None = None

    @property
    def folds(self) -> tuple[int | None, ...]:
        """The folds it has."""
        return tuple(dict.fromkeys(result.fold for result in self.results))

    @property
    def members(self) -> frozenset[tuple[int | None, int]]:
        """The fold and seed of each run."""
        return frozenset((result.fold, result.seed) for result in self.results)

    @property
    def bands(self) -> tuple[tuple[float, float], ...]:
        """Its bands of latitude, (south, north) in degrees; none for photos."""
        return tuple(dict.fromkeys(band for result in self.results for band in result.run.bands))

    def of_fold(self, fold: int | None) -> Self | None:
        """Its part of a fold, with its partner's; None without a run there."""
        results = tuple(result for result in self.results if result.fold == fold)
        partner = None if self.partner is None else self.partner.of_fold(fold)
        return replace(self, results=results, partner=partner) if results else None

    def figure(
        self,
        name: str,
        class_index: int | None = None,
        band: tuple[float, float] | None = None,
    ) -> Figure:
        """Mean over folds of the mean over seeds, with both spreads.

        Args:
            name: As in `Run.figure`.
            class_index: Of one class.
            band: Of one band of latitude.
        """
        values = self._values(name, class_index, band)
        return average([(fold, value) for (fold, _), value in values.items()])

    def kept(self, name: str, class_index: int | None = None) -> Figure:
        """What is kept of the partner's figure: the ratio of the two means, as a share of 1.

        Both means are over the folds and seeds that both rows have: a seed's panoramas were seen
        by the network of the same seed's photos. The spreads are those of the ratios of single
        folds and seeds. Pixels of photos cover nearly the same solid angle: what panoramas score by
        solid angle is compared with what photos score by pixels.

        Args:
            name: As in `figure`.
            class_index: Likewise.

        Returns:
            None for the mean where the partner has no figure, or 0.
        """
        if self.partner is None:
            return average([])
        own = self._values(name, class_index)
        base = self.partner._values(name, class_index) or self.partner._values(
            name.removesuffix("_solid_angle"), class_index
        )
        both = [key for key in own if key in base]
        folds = dict.fromkeys(fold for fold, _ in both)
        in_folds = {fold: [key for key in both if key[0] == fold] for fold in folds}
        ratios = {
            fold: _ratio(fmean(own[key] for key in keys), fmean(base[key] for key in keys))
            for fold, keys in in_folds.items()
        }
        single = [(key[0], _ratio(own[key], base[key])) for key in both]
        return replace(
            average([(fold, ratio) for fold, ratio in ratios.items() if ratio is not None]),
            mean=_ratio(
                average([(fold, own[fold, seed]) for fold, seed in both]).mean,
                average([(fold, base[fold, seed]) for fold, seed in both]).mean,
            ),
            over_seeds=average([(k, ratio) for k, ratio in single if ratio is not None]).over_seeds,
        )

    def _values(
        self,
        name: str,
        class_index: int | None = None,
        band: tuple[float, float] | None = None,
    ) -> dict[tuple[int | None, int], float]:
        found = {
            (result.fold, result.seed): result.run.figure(name, class_index, band)
            for result in self.results
        }
        return {key: value for key, value in found.items() if value is not None}


def sort_key(result: Result) -> tuple[int, int]:
    """The order of runs: by fold, then by seed."""
    return result.fold or 0, result.seed


def check_once(results: Sequence[Result], what: str) -> None:
    """Check that each fold and seed is there once.

    Args:
        results: Of one row.
        what: The row's name, for the message.

    Raises:
        DataError: One is there twice.
    """
    seen: dict[tuple[int | None, int], Result] = {}
    for result in results:
        key = (result.fold, result.seed)
        if key in seen:
            raise DataError(
                result.run.folder,
                found=f"{what} of fold {result.fold}, seed {result.seed}",
                expected=f"each once; it is also in {seen[key].run.folder}",
                remedy="Leave one of them out.",
            )
        seen[key] = result


def _ratio(own: float | None, base: float | None) -> float | None:
    return own / base if own is not None and base else None
