"""Geometry of a patch: the positions of its electrodes at rest.

x points along the upper wires, y across them, and z out of the skin. In the presets, the lower layer is at
z = 0.
"""

from __future__ import annotations

import functools
import math
import zlib
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

Float = NDArray[np.float64]

PRESETS: Final = ("aligned", "symmetric", "staggered")
PRESET_IDS: Final = {"custom": 0, "aligned": 1, "symmetric": 2, "staggered": 3}  # object 0x2000, layout id

MOST_ELECTRODES: Final = 1024
"""Maximum number of upper electrodes on a patch, for example 32 × 32. At this size, each covariance matrix of
the posterior method has 3072 rows and takes 75 MB.
"""

MOST_PAIRS: Final = 1 << 22
"""Maximum number of upper-lower electrode pairs on a patch. At this size, the offset vectors of all pairs
take 100 MB.
"""

_HASH_RESOLUTION_M: Final = 1e-9
"""Rounding unit (metres) for the coordinates in the layout hash."""


def require_array(name: str, value: ArrayLike, shape: tuple[int | str, ...], *, finite: bool = True) -> Float:
    """Return the value as a C-ordered float64 array.

    Args:
        name: Name of the argument, for error messages.
        value: The value; not copied if it is already a C-ordered float64 array.
        shape: Required shape; a string such as ``"U"`` stands for any length of at least 1.
        finite: Whether to reject NaN and infinity.

    Raises:
        ValueError: If the value cannot be converted, has the wrong shape, or must be finite but is not.
    """
    if (  # fast path for the resistances of a scan
        type(value) is np.ndarray
        and value.dtype == np.float64
        and value.shape == shape
        and not finite
        and value.flags.c_contiguous
    ):
        return value
    try:
        kind = np.asarray(value).dtype.kind
        if kind not in "biufO":  # a cast would drop imaginary parts and turn dates into numbers
            raise TypeError(f"of {np.asarray(value).dtype}")
        array = np.ascontiguousarray(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name}: not an array of real numbers ({error})") from None
    wanted = "(" + ", ".join(map(str, shape)) + ("," if len(shape) == 1 else "") + ")"
    fits = array.ndim == len(shape) and all(
        isinstance(want, str) or want == got for want, got in zip(shape, array.shape, strict=True)
    )
    if not fits:
        raise ValueError(f"{name}: got shape {array.shape}, must be {wanted}")
    if array.size == 0:
        raise ValueError(f"{name}: got shape {array.shape}, every length must be at least 1")
    if finite and not np.isfinite(array).all():
        where = tuple(int(i) for i in np.argwhere(~np.isfinite(array))[0])
        raise ValueError(f"{name}: got {array[where]} at {list(where)}, must be finite everywhere")
    return array


def _require_size(upper_wires: int, upper_electrodes: int, lower_wires: int, lower_electrodes: int) -> None:
    """Raise ValueError if a patch is too large to solve."""
    upper, lower = upper_wires * upper_electrodes, lower_wires * lower_electrodes
    if upper > MOST_ELECTRODES:
        name, got = "upper_wires × upper_electrodes", f"{upper_wires} × {upper_electrodes}"
        raise ValueError(f"{name}: got {got}, must be at most {MOST_ELECTRODES}")
    if upper * lower > MOST_PAIRS:
        raise ValueError(
            f"lower_wires × lower_electrodes: got {lower_wires} × {lower_electrodes}, must be at most "
            f"{MOST_PAIRS // upper} with {upper} upper electrodes"
        )


@dataclass(frozen=True, eq=False)
class PatchLayout:
    """Positions of a patch's electrodes at rest, and the resistivity of the rubber.

    Args:
        upper_m: (U, N, 3) electrodes of the upper wires, in metres. These electrodes move with the surface.
        lower_m: (K, M, 3) electrodes of the lower wires, in metres. These electrodes are fixed.
        resistivity_ohm_per_m: Resistance of the rubber between two electrodes, per metre of distance; called
            g in Xu et al. 2018.
        name: Name of the layout; it need not be the name of a preset.

    Raises:
        ValueError: If a shape is wrong, a coordinate is NaN, the resistivity is not positive, an upper
            electrode coincides with a lower electrode, or a limit (:data:`MOST_ELECTRODES`,
            :data:`MOST_PAIRS`) is exceeded.
    """

    upper_m: Float
    lower_m: Float
    resistivity_ohm_per_m: float = 1e7
    name: str = field(default="custom")

    def __post_init__(self) -> None:
        upper = require_array("upper_m", self.upper_m, ("U", "N", 3)).copy()
        lower = require_array("lower_m", self.lower_m, ("K", "M", 3)).copy()
        if not (math.isfinite(self.resistivity_ohm_per_m) and self.resistivity_ohm_per_m > 0):
            raise ValueError(
                f"resistivity_ohm_per_m: got {self.resistivity_ohm_per_m}, must be positive and finite"
            )
        _require_size(*upper.shape[:2], *lower.shape[:2])
        gaps = upper.reshape(-1, 1, 3) - lower.reshape(1, -1, 3)
        closest = float(np.sqrt(np.min(np.einsum("abi,abi->ab", gaps, gaps))))
        if closest < _HASH_RESOLUTION_M:
            raise ValueError(f"upper_m: an electrode is {closest} m from a lower electrode, must be farther")
        upper.setflags(write=False)
        lower.setflags(write=False)
        object.__setattr__(self, "upper_m", upper)
        object.__setattr__(self, "lower_m", lower)
        object.__setattr__(self, "resistivity_ohm_per_m", float(self.resistivity_ohm_per_m))

    def __repr__(self) -> str:
        """Return a one-line summary that omits the electrode coordinates."""
        (wires, electrodes), (lower, charges) = self.upper_m.shape[:2], self.lower_m.shape[:2]
        return (
            f"PatchLayout({self.name!r}, {wires} upper wires of {electrodes}, {lower} lower of {charges}, "
            f"pitch {1e3 * self.pitch_m:.3g} mm)"
        )

    @classmethod
    def preset(  # noqa: PLR0913 - the sizes of a patch, by keyword
        cls,
        name: str,
        *,
        pitch_m: float = 4e-3,
        height_m: float = 2e-3,
        upper_wires: int = 10,
        upper_electrodes: int = 10,
        lower_wires: int | None = None,
        lower_electrodes: int | None = None,
        resistivity_ohm_per_m: float = 1e7,
    ) -> PatchLayout:
        """Return a flat layout of a given size; calls with equal arguments return the same object.

        Layouts are immutable, and the tables of a layout (prior, joint distribution of the readings) are
        computed once for each object.

        - ``aligned``: The lower wires run along y and are evenly spaced in x. Their electrodes are offset
          from the upper wires by a quarter pitch in y, as the figure in Xu et al. 2018 suggests.
        - ``symmetric``: Same as ``aligned``, but without the offset. The Jacobian is nearly singular.
        - ``staggered``: The lower layer is half a pitch wider in x than the upper layer. The electrodes of a
          lower wire are 1.2 pitches apart, and lower wire k is shifted in y by 0.43 (k mod 3 − 1) pitches.
          The condition number of the Jacobian is up to a thousand times lower than for the other presets.

        Args:
            name: ``aligned``, ``symmetric`` or ``staggered``.
            pitch_m: Distance between neighbouring upper electrodes, in metres.
            height_m: Height of the upper electrodes above the lower layer, in metres.
            upper_wires: Number of upper wires, U.
            upper_electrodes: Number N of electrodes per upper wire.
            lower_wires: Number of lower wires, K. The default, 3 N, gives each upper wire as many resistances
                as unknown coordinates.
            lower_electrodes: Number of electrodes per lower wire, M; the default is U.
            resistivity_ohm_per_m: ρ in ohm/m; the resistance between two electrodes at distance d is ρ d.

        Raises:
            ValueError: If the name is unknown, or a number is out of range.
        """
        if name not in PRESETS:
            raise ValueError(f"name: got {name!r}, must be one of {', '.join(PRESETS)}")
        for label, length in (("pitch_m", pitch_m), ("height_m", height_m)):
            if not (math.isfinite(length) and length > 0):
                raise ValueError(f"{label}: got {length}, must be positive and finite")
        lower_wires = 3 * upper_electrodes if lower_wires is None else lower_wires
        lower_electrodes = upper_wires if lower_electrodes is None else lower_electrodes
        counts = {
            "upper_wires": upper_wires,
            "upper_electrodes": upper_electrodes,
            "lower_wires": lower_wires,
            "lower_electrodes": lower_electrodes,
        }
        for label, count in counts.items():
            if count < 1:
                raise ValueError(f"{label}: got {count}, must be at least 1")
        _require_size(**counts)
        upper, lower = (upper_wires, upper_electrodes), (lower_wires, lower_electrodes)
        return _preset(name, upper, lower, (pitch_m, height_m, resistivity_ohm_per_m))

    @property
    def shape(self) -> tuple[int, int]:
        """Shape (U, K) of the resistances of one scan."""
        return self.upper_m.shape[0], self.lower_m.shape[0]

    @property
    def unknowns(self) -> int:
        """Number of unknown coordinates per upper wire, 3 N."""
        electrodes: int = self.upper_m.shape[1]
        return 3 * electrodes

    @functools.cached_property
    def pitch_m(self) -> float:
        """Median distance between neighbouring electrodes of an upper wire, in metres.

        If each upper wire has only one electrode, the median distance from an upper electrode to the nearest
        lower electrode is used instead.
        """
        steps = np.linalg.norm(np.diff(self.upper_m, axis=1), axis=2)
        if steps.size:
            return float(np.median(steps))
        gaps = np.linalg.norm(self.upper_m.reshape(-1, 1, 3) - self.lower_m.reshape(1, -1, 3), axis=2)
        return float(np.median(gaps.min(axis=1)))

    @functools.cached_property
    def height_m(self) -> float:
        """Median height of the upper electrodes above the lower layer, in metres."""
        return float(np.median(self.upper_m[..., 2]) - np.median(self.lower_m[..., 2]))

    @functools.cached_property
    def layout_hash(self) -> int:
        """CRC-32 of the array shapes and the coordinates in nm; the host compares it with object 0x2000."""
        sizes = np.array([*self.upper_m.shape, *self.lower_m.shape], dtype="<i8")
        parts = [np.rint(a / _HASH_RESOLUTION_M).astype("<i8") for a in (self.upper_m, self.lower_m)]
        return zlib.crc32(b"".join(a.tobytes() for a in (sizes, *parts)))


@functools.lru_cache(maxsize=256)
def _preset(
    name: str,
    upper_size: tuple[int, int],
    lower_size: tuple[int, int],
    values: tuple[float, float, float],
) -> PatchLayout:
    """Return a preset layout; ``values`` are its pitch (m), height (m) and resistivity (ohm/m)."""
    (upper_wires, upper_electrodes), (lower_wires, lower_electrodes) = upper_size, lower_size
    pitch_m, height_m, resistivity_ohm_per_m = values
    upper = np.empty((upper_wires, upper_electrodes, 3))
    upper[..., 0] = np.arange(upper_electrodes)
    upper[..., 1] = np.arange(upper_wires)[:, None]
    upper[..., 2] = height_m / pitch_m
    lower = np.zeros((lower_wires, lower_electrodes, 3))
    span, index = upper_electrodes - 1.0, np.arange(lower_electrodes)
    if name == "staggered":
        lower[..., 0] = np.linspace(-0.25, span + 0.25, lower_wires)[:, None]
        middle = 0.5 * (upper_wires - 1.0)
        lower[..., 1] = middle + 1.2 * (index - 0.5 * (lower_electrodes - 1.0))
        lower[..., 1] += 0.43 * (np.arange(lower_wires) % 3 - 1.0)[:, None]
    else:
        lower[..., 0] = np.linspace(0.0, span, lower_wires)[:, None]
        lower[..., 1] = index + (0.25 if name == "aligned" else 0.0)
    return PatchLayout(upper * pitch_m, lower * pitch_m, resistivity_ohm_per_m, name)
