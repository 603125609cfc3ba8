"""Tables and keys of a scene file: ``[skin]``, bodies, touches and their motions, and faults."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Final, Literal

from pydantic import Field, PrivateAttr, ValidationError, model_validator

from skinnode.config.explain import first_error, key_path
from skinnode.config.table import Allowed, Length, Name, Table, one_of
from skinnode.config.toml_text import Document, read_toml
from skinnode.errors import NOTHING, ConfigError
from vcan_sim.scenes import shapes
from vcan_sim.skin.imperfections import Imperfections

BodyShape = Literal["sphere", "punch", "box_edge", "ridge", "fingertip"]
MotionKind = Literal["slide", "shear", "roll", "turn", "walk", "press"]

_KEYS_OF_SHAPE: Final[dict[str, tuple[str, ...]]] = {
    "sphere": ("radius_m",),
    "punch": ("radius_m", "edge_radius_m"),
    "box_edge": ("length_m", "edge_radius_m", "slope_rad"),
    "ridge": ("radius_m", "length_m"),
    "fingertip": ("radii_m",),
}
_REQUIRED_OF_SHAPE: Final[dict[str, tuple[str, ...]]] = {
    "sphere": ("radius_m",),
    "punch": ("radius_m",),
    "box_edge": ("length_m",),
    "ridge": ("radius_m", "length_m"),
    "fingertip": ("radii_m",),
}
_KEYS_OF_MOTION: Final[dict[str, tuple[str, ...]]] = {
    "slide": ("by_m",),
    "shear": ("by_m",),
    "roll": ("by_m",),
    "turn": ("by_rad",),
    "walk": ("seed", "reach_m", "every_s"),
    "press": ("depth_m", "force_n"),
}
_REQUIRED_OF_MOTION: Final[dict[str, tuple[str, ...]]] = {
    "slide": ("by_m",),
    "shear": ("by_m",),
    "roll": ("by_m",),
    "turn": ("by_rad",),
    "walk": ("reach_m",),
    "press": (),
}
KEY_OF_TRAVEL: Final[dict[str, str]] = {"slide": "by_m", "shear": "by_m", "roll": "by_m", "walk": "reach_m"}
"""Key for the distance travelled, for each kind of motion along the skin."""

_Coordinate = Annotated[float, Field(ge=-1, le=1, allow_inf_nan=False), Allowed("a number from -1 to 1")]
_Place = Annotated[
    tuple[_Coordinate, _Coordinate], Field(strict=False), Allowed("two numbers [x, y], metres, from -1 to 1")
]
_Radii = Annotated[
    tuple[Length, Length, Length], Field(strict=False), Allowed("three numbers from 1e-6 to 1 (m)")
]
_Angle = Annotated[
    float, Field(ge=-6.2832, le=6.2832, allow_inf_nan=False), Allowed("a number from -6.2832 to 6.2832")
]
_Slope = Annotated[float, Field(ge=0.01, le=1.5, allow_inf_nan=False), Allowed("a number from 0.01 to 1.5")]
_Friction = Annotated[float, Field(ge=0, le=2, allow_inf_nan=False), Allowed("a number from 0 to 2")]
_Time = Annotated[float, Field(ge=0, le=86400, allow_inf_nan=False), Allowed("a number from 0 to 86400 (s)")]
_Duration = Annotated[
    float, Field(ge=1e-3, le=86400, allow_inf_nan=False), Allowed("a number from 1e-3 to 86400 (s)")
]
_Step = Annotated[
    float, Field(ge=1e-3, le=0.1, allow_inf_nan=False), Allowed("a number from 1e-3 to 0.1 (s)")
]
_Force = Annotated[
    float, Field(ge=1e-4, le=1e4, allow_inf_nan=False), Allowed("a number from 1e-4 to 1e4 (N)")
]
_Modulus = Annotated[
    float, Field(ge=1e3, le=1e10, allow_inf_nan=False), Allowed("a number from 1e3 to 1e10 (Pa)")
]
_Poisson = Annotated[float, Field(ge=0, le=0.5, allow_inf_nan=False), Allowed("a number from 0 to 0.5")]


class SkinConfig(Table):
    """Elastic layer of the patches in the scene, bonded to a rigid base."""

    thickness_m: Length | None = None
    """Thickness of the elastic layer, in metres; default: the height of the upper electrodes above the lower
    electrodes."""
    young_pa: _Modulus | None = None
    """Young's modulus, in Pa; default: ``calibration.young_pa`` of the patch in the hand file."""
    poisson: _Poisson | None = None
    """Poisson's ratio; default: ``calibration.poisson`` of the patch in the hand file."""


class BodyConfig(Table):
    """Rigid body that touches the skin."""

    name: Name
    """Name by which touches and the ground truth refer to the body."""
    shape: Annotated[BodyShape, one_of(BodyShape)]
    """Shape of the part of the body that faces the skin."""
    radius_m: Length | None = None
    """Radius of the sphere, punch or ridge, in metres."""
    edge_radius_m: Length | None = None
    """Rounding radius (m) of the punch's rim (default: a tenth of the punch radius) or of the box's edge
    (default: 1 mm)."""
    length_m: Length | None = None
    """Length (m) of the box's edge, or of the ridge excluding its round ends. At yaw 0, both lie along x."""
    slope_rad: _Slope | None = None
    """Angle between the skin and each of the two faces that meet at the box's edge, rad; default: π/4."""
    radii_m: _Radii | None = None
    """Semi-axes (m) of the ellipsoidal fingertip along x, y (at yaw 0) and z."""
    friction: _Friction = 0.3
    """Coefficient of friction between the body and the skin."""

    @model_validator(mode="after")
    def _keys_of_shape(self) -> BodyConfig:
        _require_keys(self, "shape", self.shape, _KEYS_OF_SHAPE, _REQUIRED_OF_SHAPE)
        if self.shape == "punch" and (self.edge_radius_m or 0.0) > (self.radius_m or 0.0):
            raise ConfigError("edge_radius_m", self.edge_radius_m, f"at most radius_m, {self.radius_m}")
        return self

    def build(self) -> shapes.Shape:
        """Return the shape of the body."""
        radius, length, edge = self.radius_m or 0.0, self.length_m or 0.0, self.edge_radius_m
        if self.shape == "sphere":
            return shapes.sphere(radius)
        if self.shape == "punch":
            return shapes.punch(radius, 0.1 * radius if edge is None else edge)
        if self.shape == "box_edge":
            slope = 0.25 * math.pi if self.slope_rad is None else self.slope_rad
            return shapes.box_edge(length, slope, 1e-3 if edge is None else edge)
        if self.shape == "ridge":
            return shapes.ridge(radius, length)
        assert self.radii_m is not None
        return shapes.ellipsoid(self.radii_m)


class MotionConfig(Table):
    """Motion of a body while it touches the skin. Simultaneous motions add up."""

    kind: Annotated[MotionKind, one_of(MotionKind)]
    """``slide``: slide along the skin. ``shear``: slide along the skin and back. ``roll``: roll without slip.
    ``turn``: rotate about z. ``walk``: slide along a random path. ``press``: change the depth or
    the force."""
    from_s: _Time
    """Scene time at which the motion starts, in s."""
    to_s: _Time
    """Scene time at which the motion ends, in s."""
    by_m: _Place | None = None
    """Displacement [x, y] of the body, in m. For ``shear``, the body then returns to its starting point."""
    by_rad: _Angle | None = None
    """Angle of rotation for ``turn``, rad, counterclockwise as seen from above the skin."""
    depth_m: Length | None = None
    """Depth (m) at the end of ``press``, for a touch with ``depth_m``."""
    force_n: _Force | None = None
    """Force (N) at the end of ``press``, for a touch with ``force_n``."""
    reach_m: Length | None = None
    """Maximum distance of the body from the start of ``walk``, in metres."""
    every_s: _Duration | None = None
    """Time between consecutive random targets of ``walk``, in s; default: 0.5."""
    seed: Annotated[int, Field(ge=0), Allowed("a non-negative integer")] | None = None
    """Random seed for ``walk``; default: 1."""

    @model_validator(mode="after")
    def _keys_of_kind(self) -> MotionConfig:
        _require_keys(self, "kind", self.kind, _KEYS_OF_MOTION, _REQUIRED_OF_MOTION)
        if self.to_s <= self.from_s:
            raise ConfigError("to_s", self.to_s, f"later than from_s, {self.from_s} s")
        return self


class TouchConfig(Table):
    """One touch: a body presses on the skin, moves, and lifts off."""

    body: Name
    """Name of the body that touches the patch."""
    patch: Name
    """Name of the touched patch, as in the hand file."""
    at_m: _Place
    """Position [x, y] of the first contact in the patch frame, in metres."""
    from_s: _Time
    """Scene time of the first contact, in s."""
    to_s: _Time
    """Scene time of the last contact, in s; at least two time steps after ``from_s``."""
    ramp_s: _Duration = 0.3
    """Duration of the initial press and of the final lift, in s. Both follow minimum-jerk profiles."""
    depth_m: Length | None = None
    """Depth of the body's lowest point below the undeformed surface, in metres. Set either ``depth_m`` or
    ``force_n``."""
    force_n: _Force | None = None
    """Normal force of the touch, in N. Set either ``force_n`` or ``depth_m``."""
    yaw_rad: _Angle = 0.0
    """Rotation of the body about z, rad."""
    times: Annotated[int, Field(ge=1, le=1000), Allowed("an integer from 1 to 1000")] = 1
    """Number of times the touch is performed, such as 5 for a series of five taps."""
    every_s: _Duration | None = None
    """Interval between the starts of successive repetitions, in s. Required if ``times`` is more than 1."""
    motions: Annotated[tuple[MotionConfig, ...], Field(strict=False)] = ()
    """Motions of the body during the touch."""

    @property
    def by_force(self) -> bool:
        """True for a force-controlled touch, False for a depth-controlled touch."""
        return self.force_n is not None

    @property
    def each(self) -> tuple[TouchConfig, ...]:
        """All repetitions of the touch, as separate touches with ``times`` = 1."""
        if self.times == 1:
            return (self,)
        return tuple(self._after(number * (self.every_s or 0.0)) for number in range(self.times))

    def _after(self, delay_s: float) -> TouchConfig:
        """Return one repetition of this touch, delayed by ``delay_s``."""

        def later(table: Any, **changes: Any) -> Any:
            times = {"from_s": table.from_s + delay_s, "to_s": table.to_s + delay_s}
            return table.model_copy(update=times | changes)

        motions = tuple(later(motion) for motion in self.motions)
        return later(self, times=1, every_s=None, motions=motions)  # type: ignore[no-any-return]

    @model_validator(mode="after")
    def _times_and_level(self) -> TouchConfig:
        if (self.depth_m is None) == (self.force_n is None):
            got = None if self.depth_m is None else self.force_n
            raise ConfigError("force_n", got, "either force_n or depth_m")
        if self.to_s <= self.from_s:
            raise ConfigError("to_s", self.to_s, f"later than from_s, {self.from_s} s")
        if self.to_s - self.from_s < 2.0 * self.ramp_s * (1.0 - 1e-9):
            most = 0.5 * (self.to_s - self.from_s)
            raise ConfigError("ramp_s", self.ramp_s, f"at most half the duration of the touch, {most:g} s")
        if self.times > 1 and self.every_s is None:
            raise ConfigError(
                "every_s", NOTHING, "a number from 1e-3 to 86400 (s), because times is more than 1"
            )
        if self.times > 1 and (self.every_s or 0.0) < self.to_s - self.from_s:
            least = self.to_s - self.from_s
            raise ConfigError("every_s", self.every_s, f"at least the duration of the touch, {least:g} s")
        self._check_motions()
        return self

    def _check_motions(self) -> None:
        """Check that all motions take place during the touch and that ``press`` motions do not overlap."""
        pressed_s = 0.0
        for i, motion in enumerate(self.motions):
            key = f"motions[{i}]"
            if motion.from_s < self.from_s:
                raise ConfigError(
                    f"{key}.from_s", motion.from_s, f"at least {self.from_s} s, the start of the touch"
                )
            if motion.to_s > self.to_s:
                raise ConfigError(f"{key}.to_s", motion.to_s, f"at most {self.to_s} s, the end of the touch")
            if motion.kind != "press":
                continue
            own, other = ("force_n", "depth_m") if self.by_force else ("depth_m", "force_n")
            if getattr(motion, other) is not None:
                raise ConfigError(
                    f"{key}.{other}", getattr(motion, other), f"nothing, because the touch has {own}"
                )
            if getattr(motion, own) is None:
                raise ConfigError(f"{key}.{own}", None, f"a value, because the touch has {own}")
            if motion.from_s < pressed_s:
                raise ConfigError(
                    f"{key}.from_s", motion.from_s, f"at least {pressed_s} s, the end of the preceding press"
                )
            pressed_s = motion.to_s


_FaultText = Annotated[
    str,
    Field(min_length=1, max_length=200),
    Allowed('a fault, such as "lost=0.1" or "unplugged"'),
]


class FaultConfig(Table):
    """Scheduled faults of a patch, a wire or a bus."""

    where: Annotated[str, Field(min_length=1, max_length=80), Allowed("the name of a patch, wire or bus")]
    """Name of the faulty patch or bus, or of a wire, such as ``palm upper 3``. Wires are numbered from 0."""
    fault: _FaultText
    """Faults as in ``vcan-sim --fault``: ``unplugged``, ``lost=0.1``, or several separated by commas. For a
    wire: ``open``, ``shorted``, ``noisy``, ``frozen`` or ``crossed``."""
    from_s: _Time = 0.0
    """Scene time at which the faults start, in s."""
    to_s: _Time | None = None
    """Scene time at which the faults end, in s; default: when the scene ends or repeats."""

    @model_validator(mode="after")
    def _end_after_start(self) -> FaultConfig:
        if self.to_s is not None and self.to_s <= self.from_s:
            raise ConfigError("to_s", self.to_s, f"later than from_s, {self.from_s} s")
        return self


class SceneConfig(Table):
    """Scene: bodies that touch the patches of a hand, and faults of the patches and buses."""

    name: Name = "scene"
    """Name of the scene."""
    step_s: _Step = 0.03
    """Time step of the contact mechanics, in s. The state between time steps is interpolated. Motions
    shorter than four time steps are therefore smoothed."""
    cells: Annotated[int, Field(ge=8, le=128), Allowed("an integer from 8 to 128")] = 20
    """Number of cells across a contact. With 20 cells, errors are below 1 % for forces and below 3 % for
    areas. The computing time grows with the square of this number."""
    repeat_s: _Duration | None = None
    """Period after which the scene repeats, in s; default: the scene plays only once."""
    skin: SkinConfig = SkinConfig()
    imperfections: Annotated[
        Any,  # with a union type, error messages would list all of its members
        Field(default_factory=dict),
        Allowed('"ordinary", or a table of imperfections'),
    ]
    """Imperfections of all patches: ``"ordinary"`` for carefully manufactured patches, or a table with the
    sizes of the imperfections. The table may also contain ``ordinary = true`` and ``seed``. By default, the
    patches match their layouts exactly."""
    bodies: Annotated[tuple[BodyConfig, ...], Field(strict=False), Allowed("tables [[bodies]]")] = ()
    """Rigid bodies of the scene."""
    touches: Annotated[tuple[TouchConfig, ...], Field(strict=False), Allowed("tables [[touches]]")] = ()
    """Touches of the scene, in any order. Without touches, the skin stays at rest."""
    faults: Annotated[tuple[FaultConfig, ...], Field(strict=False), Allowed("tables [[faults]]")] = ()
    """Faults of the scene, in any order."""
    _read_of: Document = PrivateAttr(Document("", {}, {}))

    def body(self, name: str) -> BodyConfig:
        """Return the body called ``name``.

        Raises:
            KeyError: If the scene has no such body.
        """
        return {body.name: body for body in self.bodies}[name]

    def patch_imperfections(self) -> Imperfections:
        """Return the imperfections of the patches.

        Raises:
            ConfigError: If a key is unknown or a value is invalid.
        """
        given = {"ordinary": True} if self.imperfections == "ordinary" else self.imperfections
        if not isinstance(given, Mapping):
            raise ConfigError("imperfections", given, '"ordinary", or a table of imperfections')
        return Imperfections.from_table(given)

    def where(self, key: str) -> str:
        """Return the position ``file:line:column`` of a dotted key, or "" if the scene has no file."""
        return self._read_of.where(key_path(key))

    @model_validator(mode="after")
    def _imperfections_are_possible(self) -> SceneConfig:
        self.patch_imperfections()
        return self

    @model_validator(mode="after")
    def _faults_in_time(self) -> SceneConfig:
        if not (self.touches or self.faults):
            raise ConfigError("touches", NOTHING, "at least one [[touches]] or [[faults]]")
        for i, fault in enumerate(self.faults):
            last_s, key = (fault.from_s, "from_s") if fault.to_s is None else (fault.to_s, "to_s")
            if self.repeat_s is not None and last_s > self.repeat_s:
                raise ConfigError(f"faults[{i}].{key}", last_s, f"at most repeat_s, {self.repeat_s} s")
        return self

    @model_validator(mode="after")
    def _cross_checks(self) -> SceneConfig:
        names: list[str] = []
        for i, body in enumerate(self.bodies):
            if body.name in names:
                allowed = f"a value that bodies[{names.index(body.name)}] does not use"
                raise ConfigError(f"bodies[{i}].name", body.name, allowed)
            names.append(body.name)
        for i, touch in enumerate(self.touches):
            if touch.body not in names:
                allowed = f"a body of this file: {', '.join(names)}"
                raise ConfigError(f"touches[{i}].body", touch.body, allowed)
            end_s = touch.each[-1].to_s
            if self.repeat_s is not None and end_s > self.repeat_s:
                raise ConfigError(f"touches[{i}].to_s", touch.to_s, f"at most repeat_s, {self.repeat_s} s")
            least_s = touch.from_s + 2.0 * self.step_s
            if touch.to_s < least_s - 1e-9:  # there might be no time step during the touch
                allowed = f"at least {least_s:g} s, two time steps (step_s) after from_s"
                raise ConfigError(f"touches[{i}].to_s", touch.to_s, allowed)
            self._check_motions(i, touch)
            for j, other in enumerate(self.touches[:i]):
                if other.body == touch.body and _meet(touch, other):
                    allowed = f"a time at which touches[{j}] does not use the body {touch.body!r}"
                    raise ConfigError(f"touches[{i}].from_s", touch.from_s, allowed)
        return self

    def _check_motions(self, number: int, touch: TouchConfig) -> None:
        """Check that only spheres and ridges roll, and that ridges roll perpendicular to their axis."""
        body, key = self.body(touch.body), f"touches[{number}].motions"
        turns = any(motion.kind == "turn" for motion in touch.motions)
        for j, motion in enumerate(touch.motions):
            if motion.kind != "roll":
                continue
            if body.shape not in ("sphere", "ridge"):
                allowed = (
                    "a kind other than roll, which requires a sphere or a ridge; "
                    f"{body.name!r} is a {body.shape}"
                )
                raise ConfigError(f"{key}[{j}].kind", motion.kind, allowed)
            x, y = motion.by_m or (0.0, 0.0)
            along = x * math.cos(touch.yaw_rad) + y * math.sin(touch.yaw_rad)
            if body.shape == "ridge" and (turns or abs(along) > 1e-3 * math.hypot(x, y)):
                allowed = (
                    f"a displacement perpendicular to the ridge (yaw {touch.yaw_rad:g} rad), and no turn"
                )
                raise ConfigError(f"{key}[{j}].by_m", [x, y], allowed)


def _meet(one: TouchConfig, two: TouchConfig) -> bool:
    """Return whether two touches, including their repetitions, overlap in time."""
    return any(a.from_s < b.to_s and b.from_s < a.to_s for a in one.each for b in two.each)


def read_scene(path: Path | str) -> SceneConfig:
    """Read a scene file without checking it against a hand.

    :func:`vcan_sim.scenes.load_scene` also checks the scene against a hand.

    Args:
        path: Scene file.

    Raises:
        ConfigError: If the file cannot be read or is not a valid scene. The message gives the line and column
            of the error.
    """
    path = Path(path)
    return _parse(read_toml(path, "scene file"))


def parse_scene(table: Mapping[str, Any], *, where: str = "") -> SceneConfig:
    """Create a scene from a table with the keys of a scene file.

    Args:
        table: Scene in the form returned by tomllib.
        where: File name for error messages.

    Raises:
        ConfigError: If the table is not a valid scene.
    """
    return _parse(Document(where, dict(table), {}))


def _parse(document: Document) -> SceneConfig:
    try:
        scene = SceneConfig.model_validate(document.table)
    except ValidationError as error:
        raise first_error(error, SceneConfig, document.where) from None
    scene._read_of = document
    return scene


def _require_keys(
    table: Table,
    key: str,
    value: str,
    allowed: Mapping[str, tuple[str, ...]],
    required: Mapping[str, tuple[str, ...]],
) -> None:
    """Raise ConfigError if ``value`` forbids a key that is given or requires a key that is missing."""
    for name in sorted({each for keys in allowed.values() for each in keys}):
        given = getattr(table, name)
        if given is not None and name not in allowed[value]:
            owners = " or ".join(f'"{each}"' for each, keys in allowed.items() if name in keys)
            raise ConfigError(name, given, f"only with {key} = {owners}")
        if given is None and name in required[value]:
            raise ConfigError(name, NOTHING, f"a value, as required for {key} = {value!r}")
