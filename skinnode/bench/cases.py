"""Hard cases: streams on which solvers tend to fail. Every newly found failure becomes a case.

 1 symmetric layout, J rank-deficient         8 baseline drift, gain error, contact resistance
 2 thick layers                               9 wrong roots with zero residual
 3 presses of 30, 50 and 70 %                10 two indenters, shear only, edge, half off the patch
 4 a press between two frames                11 repeated presses and releases
 5 an electrode almost touching              12 curved layouts, N = 1, K < 3N, K > 3N
 6 noise and code widths                     13 the wrong model
 7 open, shorted, missing, saturated         14 wrong data not marked invalid
15 patches made to ordinary tolerances       16 the whole patch pressed

A case contains the patch model given to the solver, the options that an informed user would set, and a
generator. For each seed, the generator returns a stream of frames with the true displacements.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from skinnode.bench.case import (
    DRIFT,
    FINE,
    MODEL_ERROR,
    PATHS,
    PITCH_M,
    STRIDE,
    TRACKERS,
    Case,
    narrowed,
    preset,
    press_and_release,
    pressing,
)
from skinnode.bench.fault_cases import fault_cases
from skinnode.bench.truth import Converter, Press, Skin, Stream, random_press, stream
from skinnode.model.layout import Float, PatchLayout


def all_cases() -> list[Case]:
    """Return all hard cases of ``skinnode bench stability``."""
    return [
        *_symmetric_and_thick(),
        *_deep(),
        *_sudden_and_close(),
        *_noise(),
        *_faults(),
        *_drift(),
        *_wrong_roots(),
        *_sheared(),
        *_contacts(),
        *_shapes(),
        *_wrong_models(),
        *fault_cases(),
    ]


def _exact(number: int, name: str, layout: PatchLayout, depth: float, samples: int) -> Case:
    """Return a case in which all path methods and the exact tracker solve a noise-free press."""
    skin = Skin(narrowed(layout))
    shares = np.linspace(0.0, 1.0, samples + 1)
    make = pressing(skin, depth, Converter(), shares)
    return Case(number, name, skin, make, (*PATHS, "exact"), Converter(), stride=STRIDE)


def _noisy(number: int, name: str, layout: PatchLayout, depth: float, steps: int) -> Case:
    skin = Skin(layout)
    return Case(number, name, skin, pressing(skin, depth, FINE, press_and_release(steps)))


def _symmetric_and_thick() -> Iterator[Case]:
    for depth in (0.1, 0.3):
        layout, name = preset("symmetric", 0.5), f"symmetric h=0.5, {depth:.0%}"
        yield _exact(1, f"{name}, exact data", layout, depth, 20)
        yield _noisy(1, name, layout, depth, 3)
    for kind, height in (("staggered", 1.5), ("staggered", 2.0), ("aligned", 1.5)):
        layout, name = preset(kind, height), f"{kind} h={height:g}, 10%"
        yield _exact(2, f"{name}, exact data", layout, 0.1, 20)
        yield _noisy(2, name, layout, 0.1, 3)


def _deep() -> Iterator[Case]:
    for kind, height in (
        ("staggered", 0.3),
        ("staggered", 0.5),
        ("staggered", 1.0),
        ("aligned", 0.5),
        ("aligned", 1.0),
    ):
        for depth in (0.3, 0.5, 0.7):
            layout, name = preset(kind, height), f"{kind} h={height:g}, {depth:.0%}"
            yield _exact(3, f"{name}, exact data", layout, depth, 20)
            yield _noisy(3, name, layout, depth, round(5 * depth) + 2)


def _sudden_and_close() -> Iterator[Case]:
    jump = np.array([0.0, 0.0, 1.0, 1.0, 0.0])
    for kind, height in (("staggered", 0.3), ("staggered", 0.5), ("staggered", 1.0), ("aligned", 0.5)):
        skin = Skin(preset(kind, height))
        name = f"50% between two frames, {kind} h={height:g}"
        few = Skin(narrowed(skin.layout))
        exact = pressing(few, 0.5, Converter(), jump[:3])
        yield Case(4, f"{name}, exact data", few, exact, (*PATHS, "exact"), Converter())
        yield Case(4, name, skin, pressing(skin, 0.5, FINE, jump))
    for height in (0.3, 0.5):
        skin = Skin(preset("staggered", height))
        name = f"almost touching, staggered h={height:g}"
        path = pressing(skin, 1.0, Converter(), np.linspace(0, 1, 29), presses=_touching(skin))
        yield Case(5, f"{name}, exact data", skin, path, (*PATHS, "exact"), Converter(), stride=STRIDE)
        shares = press_and_release(7)
        yield Case(5, name, skin, pressing(skin, 1.0, FINE, shares, presses=_touching(skin)))


def _touching(skin: Skin) -> Callable[[np.random.Generator], tuple[Press, ...]]:
    """Return a generator of presses that leave an electrode only 0.05 layer heights above the lower layer."""
    layout = skin.layout
    gap = layout.upper_m[..., None, None, :2] - layout.lower_m[None, None, ..., :2]
    beside = np.linalg.norm(gap, axis=-1).min(axis=(2, 3))
    beside[:2], beside[-2:], beside[:, :2], beside[:, -2:] = np.inf, np.inf, np.inf, np.inf
    nearest = np.argsort(beside.ravel())[:6]

    def presses(rng: np.random.Generator) -> tuple[Press, ...]:
        wire, electrode = np.unravel_index(int(rng.choice(nearest)), beside.shape)
        x, y, _ = layout.upper_m[wire, electrode]
        radius = float(rng.uniform(1.5, 3.0)) * layout.pitch_m
        return (Press((float(x), float(y)), radius, 0.95 * layout.height_m),)

    return presses


def _noise() -> Iterator[Case]:
    shares = press_and_release(3)
    for kind in ("staggered", "aligned"):
        skin = Skin(preset(kind, 0.5))
        for sigma in (1e-6, 1e-5, 1e-4, 1e-3, 1e-2):
            converter = Converter(sigma=sigma)
            make = pressing(skin, 0.2, converter, shares)
            yield Case(6, f"noise {sigma:.0e}, {kind} h=0.5", skin, make, TRACKERS, converter)
        for bits in (12, 14, 16, 24):
            converter = Converter(bits=bits)
            make = pressing(skin, 0.2, converter, shares)
            yield Case(6, f"{bits}-bit codes, {kind} h=0.5", skin, make, TRACKERS, converter)


def _faults() -> Iterator[Case]:
    skin = Skin(preset("staggered", 0.5))
    shares = np.array([0.0, 0.3, 0.6, 1.0, 1.0, 0.5, 0.0])
    faults: dict[str, Callable[[np.random.Generator, Stream, Skin], Stream]] = {
        "open lower wire": _open_lower,
        "shorted lower wire": _shorted_lower,
        "open upper wire": _open_upper,
        "missing chunks": _missing_chunks,
        "impossible values": _impossible,
        "a frame of garbage": _garbage,
    }
    for name, spoil in faults.items():
        yield Case(7, name, skin, pressing(skin, 0.3, FINE, shares, spoil=spoil))
    narrow = Converter(bits=16, lo=0.7, hi=1.02)
    yield Case(7, "saturated codes", skin, pressing(skin, 0.5, narrow, shares), TRACKERS, narrow)


def _spoilt(taken: Stream, frames: Float, valid: np.ndarray) -> Stream:
    return Stream(frames, valid, taken.noise, taken.truth_m, taken.force_n, taken.presses)


def _open_lower(rng: np.random.Generator, taken: Stream, skin: Skin) -> Stream:
    """Open a lower wire for three frames of the press and mark its readings invalid."""
    frames, valid, k = taken.frames_ohm.copy(), taken.valid.copy(), rng.integers(skin.layout.shape[1])
    frames[2:5, :, k], valid[2:5, :, k] = np.nan, False
    return _spoilt(taken, frames, valid)


def _shorted_lower(rng: np.random.Generator, taken: Stream, skin: Skin) -> Stream:
    """Set the readings of a lower wire to 0 ohm for three frames without marking them invalid."""
    frames, k = taken.frames_ohm.copy(), rng.integers(skin.layout.shape[1])
    frames[2:5, :, k] = 0.0
    return _spoilt(taken, frames, taken.valid)


def _open_upper(rng: np.random.Generator, taken: Stream, skin: Skin) -> Stream:
    frames, valid, u = taken.frames_ohm.copy(), taken.valid.copy(), rng.integers(skin.layout.shape[0])
    frames[2:5, u], valid[2:5, u] = np.nan, False
    return _spoilt(taken, frames, valid)


def _missing_chunks(rng: np.random.Generator, taken: Stream, skin: Skin) -> Stream:
    """Drop five random chunks of three codes in every frame."""
    frames, valid = taken.frames_ohm.copy(), taken.valid.copy()
    for t in range(len(frames)):
        flat, lost = valid[t].reshape(-1), rng.choice(valid[t].size // 3, 5, replace=False)
        flat[(3 * lost[:, None] + np.arange(3)).ravel()] = False
        frames[t][~valid[t]] = np.nan
    return _spoilt(taken, frames, valid)


def _impossible(rng: np.random.Generator, taken: Stream, skin: Skin) -> Stream:
    """Insert zero, negative, infinite and NaN resistances during the press, all marked valid."""
    frames = taken.frames_ohm.copy()
    for t in (2, 3, 4):
        where = rng.choice(frames[t].size, 4, replace=False)
        frames[t].reshape(-1)[where] = (0.0, -1e3, np.inf, np.nan)
    return _spoilt(taken, frames, taken.valid)


def _garbage(rng: np.random.Generator, taken: Stream, skin: Skin) -> Stream:
    """Replace one frame with random resistances that no deformation can produce."""
    frames = taken.frames_ohm.copy()
    frames[4] = skin.rest_ohm * rng.uniform(0.3, 1.2, skin.layout.shape)
    return _spoilt(taken, frames, taken.valid)


def _drift() -> Iterator[Case]:
    shares = np.array([0.0, 0.3, 0.6, 1.0, 0.5, 0.0])

    def common(rng: np.random.Generator, samples: int) -> Float:
        end = rng.choice((-DRIFT, DRIFT))
        return 1.0 + np.linspace(0.0, end, samples)[:, None, None]

    def each_wire(rng: np.random.Generator, samples: int) -> Float:
        end = rng.uniform(-DRIFT, DRIFT, 10)
        return 1.0 + np.linspace(0.0, 1.0, samples)[:, None, None] * end[None, :, None]

    def step(rng: np.random.Generator, samples: int) -> Float:
        return np.full((samples, 1, 1), 1.0 + rng.choice((-DRIFT, DRIFT)))

    for kind in ("staggered", "aligned"):
        skin = Skin(preset(kind, 0.5))
        where = f"{kind} h=0.5"
        for name, gain, drift in (
            ("drift of the patch to 2%", common, "patch"),
            ("drift of every wire to 2%", each_wire, "wire"),
            ("gain error of 2%", step, "patch"),
        ):
            make = pressing(skin, 0.3, FINE, shares, gain=gain)
            yield Case(8, f"{name}, {where}", skin, make, drift=drift)
    series = Skin(preset("staggered", 0.5), series=0.01)
    make = pressing(series, 0.3, FINE, shares)
    yield Case(8, "contact resistance of 1%, staggered h=0.5", series, make, model_error=0.01)


def _wrong_roots() -> Iterator[Case]:
    yield _exact(9, "staggered h=1, 70%, 100 samples", preset("staggered", 1.0), 0.7, 100)
    yield _exact(9, "aligned h=0.5, 30%, 100 samples", preset("aligned", 0.5), 0.3, 100)
    for height, converter in ((0.5, FINE), (1.5, Converter())):
        skin = Skin(preset("staggered", height))
        for name, detour in (("swapped electrodes", _swap), ("mirror branch", _mirror)):
            make = _after_detour(skin, detour, converter)
            yield Case(9, f"{name}, staggered h={height:g}", skin, make, TRACKERS, converter)


def _sheared() -> Iterator[Case]:
    """Yield deep presses with a friction coefficient of 0.8, in which wires cross folds of the potential F.

    Beyond a fold, the posterior and the live trackers converge to a smooth but wrong root on some wires. Path
    methods also use the intermediate samples, which reveal the wrong root.
    """
    for name, height in (("aligned", 0.5), ("aligned", 1.0), ("staggered", 1.0)):
        for contacts in (1, 2):
            skin = Skin(preset(name, height))

            def dragged(
                rng: np.random.Generator, layout: PatchLayout = skin.layout, contacts: int = contacts
            ) -> tuple[Press, ...]:
                return tuple(_dragged(random_press(rng, layout, 0.7), rng) for _ in range(contacts))

            many = "contact" if contacts == 1 else "contacts"
            title = f"{name} h={height:g}, 70%, shear 0.8, {contacts} {many}"
            make = pressing(skin, 0.7, Converter(), np.linspace(0.0, 1.0, 21), presses=dragged)
            known = ("path gauss_newton",) if (name, contacts) == ("staggered", 2) else ()
            yield Case(9, title, skin, make, PATHS, Converter(), known_wrong=known)


def _dragged(press: Press, rng: np.random.Generator) -> Press:
    """Return a copy of the press with a shear traction of 0.8 times the pressure in a random direction."""
    angle = rng.uniform(0.0, 2.0 * np.pi)
    traction = (0.8 * float(np.cos(angle)), 0.8 * float(np.sin(angle)))
    return Press(press.center_m, press.radius_m, press.depth_m, traction)


def _swap(rng: np.random.Generator, layout: PatchLayout, share: float) -> Float:
    """Rotate two adjacent electrodes about their midpoint; the potential is equal at 0° and 180°."""
    wire, first = rng.integers(layout.shape[0]), rng.integers(layout.upper_m.shape[1] - 1)
    middle = 0.5 * (layout.upper_m[wire, first] + layout.upper_m[wire, first + 1])
    angle = np.pi * share
    turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    moved = np.zeros(layout.upper_m.shape)
    for electrode in (first, first + 1):
        arm = layout.upper_m[wire, electrode] - middle
        moved[wire, electrode] = turn @ arm - arm
    return moved


def _mirror(rng: np.random.Generator, layout: PatchLayout, share: float) -> Float:
    """Move an electrode through the lower layer to its mirror position, where the potential is the same."""
    moved = np.zeros(layout.upper_m.shape)
    wire, electrode = rng.integers(layout.shape[0]), rng.integers(layout.upper_m.shape[1])
    moved[wire, electrode, 2] = -2 * share * layout.height_m
    return moved


def _after_detour(
    skin: Skin,
    detour: Callable[[np.random.Generator, PatchLayout, float], Float],
    converter: Converter,
) -> Callable[[np.random.Generator], Stream]:
    """Return a generator of streams that consist of an impossible motion followed by a press.

    The motion ends with every resistance back at its rest value: swapping two electrodes of a wire, or
    mirroring one, leaves the potential unchanged. The true displacement during the motion is undefined (NaN).
    """

    def make(rng: np.random.Generator) -> Stream:
        seed = rng.integers(2**32)
        turns = np.linspace(0.0, 1.0, 7)
        odd = np.stack([detour(np.random.default_rng(seed), skin.layout, turn) for turn in turns])
        resistance = np.stack([skin.resistance_ohm(moved) for moved in odd])
        frames, valid, noise = converter.read(resistance, skin.rest_ohm, rng)
        press = (random_press(rng, skin.layout, 0.2),)
        after = stream(skin, press, np.array([0.3, 0.6, 1.0, 0.0]), converter, rng)
        odd[0], odd[1:-1], odd[-1] = 0.0, np.nan, 0.0  # at both ends, all resistances have their rest values
        return Stream(
            np.concatenate([frames, after.frames_ohm]),
            np.concatenate([valid, after.valid]),
            np.concatenate([noise, after.noise]),
            np.concatenate([odd, after.truth_m]),
            np.concatenate([np.full((len(odd), 3), np.nan), after.force_n]),
            press,
        )

    return make


def _contacts() -> Iterator[Case]:
    shares = press_and_release(3)
    for kind in ("staggered", "aligned"):
        skin = Skin(preset(kind, 0.5))
        layout = skin.layout

        def two(rng: np.random.Generator, layout: PatchLayout = layout) -> tuple[Press, ...]:
            y, other = rng.uniform(2.0, 7.0, 2) * PITCH_M
            deep = Press((2.5 * PITCH_M, y), 2.0 * PITCH_M, 0.3 * layout.height_m)
            return deep, Press((7.0 * PITCH_M, other), 1.5 * PITCH_M, 0.2 * layout.height_m, (0.3, 0.0))

        def shear(rng: np.random.Generator, layout: PatchLayout = layout) -> tuple[Press, ...]:
            press = random_press(rng, layout, 0.4, shear=1.0)
            return (Press(press.center_m, press.radius_m, press.depth_m, press.traction_ratio, True),)

        def edge(rng: np.random.Generator, layout: PatchLayout = layout) -> tuple[Press, ...]:
            return (random_press(rng, layout, 0.3, where="edge"),)

        def half_off(rng: np.random.Generator, layout: PatchLayout = layout) -> tuple[Press, ...]:
            return (random_press(rng, layout, 0.3, where="half off"),)

        def flat(rng: np.random.Generator, layout: PatchLayout = layout) -> tuple[Press, ...]:
            return (random_press(rng, layout, 0.15, radius=(40.0, 60.0), margin=4.0),)

        for name, presses in (
            ("two indenters", two),
            ("shear only", shear),
            ("on the edge", edge),
            ("half off the patch", half_off),
            ("almost flat", flat),
        ):
            make = pressing(skin, 0.0, FINE, shares, presses=presses)
            yield Case(10, f"{name}, {kind} h=0.5", skin, make)
    skin = Skin(preset("staggered", 0.5))
    yield Case(11, "press and release, six times", skin, _many_times(skin))


def _many_times(skin: Skin) -> Callable[[np.random.Generator], Stream]:
    def make(rng: np.random.Generator) -> Stream:
        parts = [
            stream(
                skin,
                (random_press(rng, skin.layout, float(rng.uniform(0.1, 0.4))),),
                np.array([0.5, 1.0, 0.0]),
                FINE,
                rng,
            )
            for _ in range(6)
        ]
        return Stream(
            np.concatenate([part.frames_ohm for part in parts]),
            np.concatenate([part.valid for part in parts]),
            np.concatenate([part.noise for part in parts]),
            np.concatenate([part.truth_m for part in parts]),
            np.concatenate([part.force_n for part in parts]),
        )

    return make


def fingertip(radius_m: float = 20e-3) -> Skin:
    """Return the staggered patch with h = 0.5, bent about an axis perpendicular to the upper wires."""
    flat = preset("staggered", 0.5)
    middle = float(flat.upper_m[..., 0].mean())
    turned = []
    for points in (flat.upper_m, flat.lower_m):
        angle = (points[..., 0] - middle) / radius_m
        away = radius_m + points[..., 2] - flat.height_m
        turned.append(np.stack([away * np.sin(angle), points[..., 1], away * np.cos(angle)], axis=-1))
    angle = (flat.upper_m[..., 0] - middle) / radius_m
    along = np.stack([np.cos(angle), 0 * angle, -np.sin(angle)], axis=-1)
    across = np.broadcast_to([0.0, 1.0, 0.0], along.shape)
    out = np.stack([np.sin(angle), 0 * angle, np.cos(angle)], axis=-1)
    layout = PatchLayout(turned[0], turned[1], name="fingertip")
    return Skin(layout, points_m=flat.upper_m[..., :2], axes=np.stack([along, across, out], axis=-2))


def _shapes() -> Iterator[Case]:
    shares = press_and_release(3)
    flat, tip = preset("staggered", 0.5), fingertip()

    def on_tip(rng: np.random.Generator) -> tuple[Press, ...]:
        return (random_press(rng, flat, 0.3),)

    yield Case(12, "fingertip, 30%", tip, pressing(tip, 0.3, FINE, shares, presses=on_tip))
    for lower, depth in ((3, 0.1), (6, 0.3)):
        # With one electrode per upper wire, all upper electrodes lie on one line.
        layout = PatchLayout.preset("staggered", upper_electrodes=1, lower_wires=lower)
        skin = Skin(layout)

        def on_line(
            rng: np.random.Generator, layout: PatchLayout = layout, depth: float = depth
        ) -> tuple[Press, ...]:
            center = (float(rng.uniform(-0.5, 0.5)) * PITCH_M, float(rng.uniform(2, 7)) * PITCH_M)
            return (Press(center, 2 * PITCH_M, depth * layout.height_m, (0.2, 0.1)),)

        make = pressing(skin, depth, FINE, shares, presses=on_line)
        yield Case(12, f"N = 1, K = {lower}, {depth:.0%}", skin, make)
    for lower in (20, 40):
        skin = Skin(PatchLayout.preset("staggered", lower_wires=lower))
        methods = TRACKERS if lower >= skin.layout.unknowns else TRACKERS[1:]
        yield Case(12, f"K = {lower}, 3N = 30, 30%", skin, pressing(skin, 0.3, FINE, shares), methods)


def _wrong_models() -> Iterator[Case]:
    shares = press_and_release(3)
    for kind in ("staggered", "aligned"):
        layout = preset(kind, 0.5)
        for name, skin in (
            ("electrodes of 0.1 pitch", Skin(layout, electrode=0.1)),
            ("resistivity +5% of strain", Skin(layout, strain=0.05)),
            ("resistivity -5% of strain", Skin(layout, strain=-0.05)),
            ("5% thicker", Skin(layout, height=1.05)),
            ("5% thinner", Skin(layout, height=0.95)),
        ):
            make = pressing(skin, 0.3, FINE, shares)
            yield Case(13, f"{name}, {kind} h=0.5", skin, make, model_error=MODEL_ERROR)
