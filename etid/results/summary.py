"""Medians, spreads and errors of groups of fits."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from etid.results.fits import Fits


@np.errstate(over="ignore", invalid="ignore")  # of a damaged file
def summary(fits: "Fits", by: Sequence[str]) -> list[dict[str, Any]]:
    """The rows of `Fits.summary`."""
    columns = [map(str, fits.labels[name].tolist()) for name in by]
    keys = list(zip(*columns, strict=True)) if by else [()] * len(fits)
    groups = sorted(set(keys))
    number = {key: i for i, key in enumerate(groups)}
    place = np.array([number[key] for key in keys], int)
    good = fits.successful()
    place_good = place[fits.verdicts == "successful"]
    order = np.argsort(place_good, kind="stable")
    ends = np.searchsorted(place_good[order], np.arange(len(groups) + 1))
    rows: list[dict[str, Any]] = [
        dict(zip(by, key, strict=True)) | {"fits": int(count), "successful": int(size)}
        for key, count, size in zip(
            groups, np.bincount(place, minlength=len(groups)), np.diff(ends), strict=True
        )
    ]
    for i, name in enumerate(fits.circuit.names()):
        total, common = good.cov[:, i, i], good.fit.shared_cov[:, i, i]
        parts = {
            "": np.asarray(getattr(good.circuit, name)),
            "_stderr": np.asarray(getattr(good.stderr, name)),
            "_own": np.sqrt(np.maximum(total - common, 0.0)),
            "_shared": np.sqrt(np.where(common >= 0, common, np.nan)),
        }
        for row, start, end in zip(rows, ends[:-1], ends[1:], strict=True):
            chosen = order[start:end]
            for part, values in parts.items():
                row[name + part] = float(np.median(values[chosen])) if end > start else np.nan
            several, values = chosen.size > 1, parts[""][chosen]
            row[f"{name}_spread"] = float(np.std(values, ddof=1)) if several else np.nan
            noise = float(np.mean(parts["_own"][chosen] ** 2)) if several else np.nan
            excess = np.square(row[f"{name}_spread"]) - noise
            row[f"{name}_between"] = float(np.sqrt(np.maximum(excess, 0.0)))
    return rows
