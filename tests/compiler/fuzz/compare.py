"""How near two results must be, and where they may differ.

| what | where the two may differ | what is compared |
|---|---|---|
| functions of the C library (sin, exp, pow, ...) | XLA has polynomials of its own | to the units in `operations.ULPS` |
| numbers below the smallest normal one | XLA's threads flush them to 0 | one may be 0; no function of them |
| sums and products of many floats | in pairs, in a loop, in XLA's order | numbers where each order gives the same |
| the least and the largest of many floats | XLA loses a NaN (`reduce_min` of 4,097 in float32) | numbers |
| `clz` of a known negative number | XLA has −56, where it has 0 of one that is not known | numbers that are not known |
| a / b of a known b | XLA multiplies by 1/b | to 1 unit |
| a·b + c | rounded once or twice | numbers where that is the same |
| complex products, quotients | Smith's quotient here | finite ones, divisors not 0, to 16 units |
| `select_n` of a number out of range | the nearest case here | nothing |
| windows of one `scatter` that overlap | the last one stays here | such as write the same |
| derivatives | equal equations, rounded differently; all may cancel | to 64 units, and 256 of the largest result or of 1/16 |
"""

from typing import Any

import numpy as np


# A derivative by operands of about 1 that cancels in every entry, as atan2's along (x, y) itself, is as far off as its terms are rounded.
LEAST = 1 / 16


def difference(found: Any, wanted: Any, ulps: float = 0, scale: float = 0) -> tuple[int, ...] | None:
    """Where the first array is not what the second says, nothing where it is.

    Integers and truth values must be the same, and floats of `ulps` and `scale` 0, with the sign of a zero. Other floats may be
    `ulps` units in the last place off, and `scale` such units of the largest, or of `LEAST`; what is not a number must be so in both.
    """
    found, wanted = np.asarray(found), np.asarray(wanted)
    assert (found.dtype, found.shape) == (wanted.dtype, wanted.shape), (
        found.dtype,
        wanted.dtype,
        found.shape,
        wanted.shape,
    )
    same = _same(found, wanted, ulps, scale)
    return None if same.all() else tuple(map(int, np.argwhere(~same)[0]))


def _same(found: np.ndarray, wanted: np.ndarray, ulps: float, scale: float) -> np.ndarray:
    if found.dtype.kind == "c":
        size = np.abs(wanted)
        return _near(found.real, wanted.real, ulps, scale, size) & _near(found.imag, wanted.imag, ulps, scale, size)
    if found.dtype.kind != "f":
        return found == wanted
    return _near(found, wanted, ulps, scale, np.abs(wanted))


def _near(found: np.ndarray, wanted: np.ndarray, ulps: float, scale: float, size: np.ndarray) -> np.ndarray:
    info = np.finfo(found.dtype)
    finite = np.where(np.isfinite(wanted), np.abs(wanted), 0)
    with np.errstate(all="ignore"):
        most = ulps * info.eps * np.where(np.isfinite(size), size, finite) + scale * info.eps * finite.max(
            initial=LEAST
        )
        near = np.isfinite(found) & np.isfinite(wanted) & (np.abs(found - wanted) <= most)
        # Rounded to infinity in one of them.
        near |= (ulps > 0) & (np.abs(found) >= info.max) & (np.abs(wanted) >= info.max) & (found * wanted > 0)
        flushed = (np.abs(found) <= info.tiny) & (np.abs(wanted) <= info.tiny)
    same = (found == wanted) & ((found != 0) | (np.signbit(found) == np.signbit(wanted)) | (ulps + scale > 0))
    return near | same | (np.isnan(found) & np.isnan(wanted)) | (flushed & ((found != 0) | (wanted != 0)))
