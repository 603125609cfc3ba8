"""Writes pictures, curves and text to a Rerun recording stream."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Final

import numpy as np
import rerun as rr

from skinnode.config import HandConfig
from skinnode.host import HandFrame
from skinnode.host.hand_frame import LATE
from skinnode.host.skeleton import Skeleton
from skinnode.model.frames import FieldFrame
from skinnode.model.layout import Float
from skinnode.model.pose import Pose
from skinnode.monitor.field_map import Scale
from skinnode.monitor.patch_panel import GONE
from skinnode.monitor.view_model import View, log_line
from skinnode.view import blueprint as window
from skinnode.view.geometry import edge_m, triangles
from skinnode.view.picture import (
    FORCE_M_PER_N,
    SHEAR,
    PatchPicture,
    Style,
    picture_of,
    stale_picture_of,
)
from skinnode.view.placement import ROOT, Placement, placement_of
from skinnode.view.texts import contacts_text, health_text
from skinnode.view.tick import Tick

SHEAR_RGB: Final = (0, 150, 170)
FORCE_RGB: Final = (20, 110, 230)
EDGE_RGB: Final = (120, 128, 140)
STD_RGB: Final = (70, 100, 150)
_CONTACT_RGB: Final = (40, 44, 52)
_THIN: Final = 0.04
"""Line radius, in electrode pitches."""
_PALETTE: Final = (
    (31, 119, 180),
    (255, 127, 14),
    (44, 160, 44),
    (214, 39, 40),
    (148, 103, 189),
    (140, 86, 75),
    (227, 119, 194),
    (127, 127, 127),
    (188, 189, 34),
    (23, 190, 207),
)
"""Colours of the patches' curves: matplotlib's "tab10" (CC0)."""
_LEVELS: Final = {"good": "INFO", "note": "WARN", "bad": "ERROR"}


class HandDrawing:
    """Drawing of a hand in a Rerun recording stream. Only one thread may use it.

    Args:
        stream: The recording stream; the caller sets its sinks and closes it.
        hand: The hand.
        exaggeration: Ratio of drawn to measured displacement.
        wall_minus_mono_ns: Wall-clock time minus tick time, in ns.
        live: Whether the viewer follows the newest data.
    """

    def __init__(
        self,
        stream: rr.RecordingStream,
        hand: HandConfig,
        *,
        exaggeration: float,
        wall_minus_mono_ns: int,
        live: bool,
    ) -> None:
        self._stream, self._hand, self._live, self._begun = stream, hand, live, False
        self._exaggeration, self._wall_minus_mono_ns = exaggeration, wall_minus_mono_ns
        layouts = {patch.name: patch.layout.build() for patch in hand.patches}
        self._rest_m = {name: layout.upper_m for name, layout in layouts.items()}
        self._pitch_m = {name: layout.pitch_m for name, layout in layouts.items()}
        self.placement: Placement = placement_of(hand, layouts)
        self._skeleton = Skeleton.of(hand)  # of the hand file, even if the patches are drawn side by side
        self._paths = {name: rr.new_entity_path(self.placement.path(name)) for name in layouts}
        self._scale = Scale()
        self._newest: dict[str, FieldFrame] = {}
        self._stale: set[str] = set()
        self._touched: set[str] = set()
        """Patches whose newest picture has contacts."""

    def _begin(self, t_ns: int) -> None:
        """Write the window layout and everything that does not change."""
        self._begun = True
        log, skeleton = self._stream.log, self.placement.skeleton
        corners = [
            (skeleton.link_pose(mount.link) @ mount.pose).points_m(edge_m(rest_m))
            for name, rest_m in self._rest_m.items()
            for mount in (skeleton.mount(name),)
        ]
        self._stream.send_blueprint(window.blueprint(np.concatenate(corners), live=self._live))
        log(ROOT, rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        for name, rest_m in self._rest_m.items():
            mount, path = skeleton.mount(name), self._paths[name]
            log(
                rr.new_entity_path(self.placement.path(name)[:-1]),
                _transform(skeleton.link_pose(mount.link)),
                static=True,
            )
            log(path, _transform(mount.pose), static=True)
            log(
                f"{path}/surface",
                rr.Mesh3D.from_fields(triangle_indices=triangles(*rest_m.shape[:2])),
                static=True,
            )
            self._log_outline(name)
            thin_m = _THIN * self._pitch_m[name]
            log(f"{path}/surface", rr.Arrows3D.from_fields(radii=2 * thin_m, colors=SHEAR_RGB), static=True)
            log(
                f"{path}/contacts",
                rr.Arrows3D.from_fields(radii=6 * thin_m, colors=FORCE_RGB),
                rr.Ellipsoids3D.from_fields(colors=STD_RGB, fill_mode="solid", show_labels=True),
                rr.LineStrips3D.from_fields(radii=2 * thin_m, colors=_CONTACT_RGB),
                static=True,
            )
            self._set_time(t_ns)
            self._draw(name, stale_picture_of(rest_m))
        names = list(self._rest_m)
        colours = [_PALETTE[number % len(_PALETTE)] for number in range(len(names))]
        for path, lines, shades, widths in (
            (window.FORCE, [*names, "whole hand"], [*colours, _CONTACT_RGB], [*[1.5] * len(names), 3.0]),
            (window.DEPTH, names, colours, [1.5] * len(names)),
            (window.LOAD, [bus.name for bus in self._hand.buses], None, None),
        ):
            log(path, rr.SeriesLines(names=lines, colors=shades, widths=widths), static=True)

    def _log_outline(self, name: str) -> None:
        """Write the edge and the name of a patch at its electrode positions at rest."""
        rest_m, path = self._rest_m[name], self._paths[name]
        edge = rr.LineStrips3D([edge_m(rest_m)], colors=EDGE_RGB, radii=1.5 * _THIN * self._pitch_m[name])
        self._stream.log(f"{path}/edge", edge, static=True)
        below = 0.5 * (rest_m[0, 0] + rest_m[0, -1]) - [0.0, self._pitch_m[name], 0.0]
        label = rr.Points3D([below], labels=[name], radii=1e-5, colors=_CONTACT_RGB)
        self._stream.log(f"{path}/name", label, static=True)

    def draw(self, tick: Tick) -> None:
        """Write the new data for one instant.

        Args:
            tick: New fields and, at some instants, the hand's state.
        """
        self._rest_m.update(tick.supplied_m)
        if not self._begun:
            self._begin(
                min((_time_ns(field, tick.t_ns) for field in tick.fields.values()), default=tick.t_ns)
            )
        else:
            for name in tick.supplied_m:
                self._log_outline(name)
        deepest_m = max((_deepest_m(field) for field in tick.fields.values()), default=0.0)
        self._scale.update(tick.t_ns, deepest_m)
        for name, field in tick.fields.items():
            self._newest[name] = field
            self._stale.discard(name)
            self._set_time(_time_ns(field, tick.t_ns), field)
            style = Style(self._exaggeration, self._scale.full_m, self._pitch_m[name])
            self._draw(name, picture_of(field, self._rest_m[name], style))
        self._stream.reset_time()
        self._set_time(tick.t_ns)
        if tick.fields:
            self._draw_curves()
        if tick.view is not None:
            self._draw_state(tick, tick.view)
        for event in tick.events:
            line = log_line(event, self._wall_minus_mono_ns)
            self._set_time(event.t_ns)
            self._stream.log(window.EVENTS, rr.TextLog(f"{line.time}  {event}", level=_LEVELS[line.level]))

    def _draw(self, name: str, picture: PatchPicture) -> None:
        """Write the data that change with each field; :meth:`_begin` has written colours and radii.

        Each call to ``log`` takes about 100 µs of CPU time, so this method makes only two calls, or one if
        there are no contacts.
        """
        log, path, narrow = self._stream.log, self._paths[name], np.float32
        log(
            f"{path}/surface",
            rr.Mesh3D.from_fields(
                vertex_positions=picture.points_m.astype(narrow),
                vertex_normals=picture.normals.astype(narrow),
                vertex_colors=picture.rgba.view(">u4").ravel().astype(np.uint32),
            ),
            rr.Arrows3D.from_fields(
                origins=picture.shear_origins_m.astype(narrow), vectors=picture.shear_m.astype(narrow)
            ),
        )
        touched, before = bool(picture.labels), name in self._touched
        if touched != before:
            self._touched ^= {name}
        if touched or before:
            log(
                f"{path}/contacts",
                rr.Arrows3D.from_fields(
                    origins=picture.force_origins_m.astype(narrow), vectors=picture.force_m.astype(narrow)
                ),
                rr.Ellipsoids3D.from_fields(
                    centers=picture.force_origins_m.astype(narrow),
                    half_sizes=picture.force_std_m.astype(narrow),
                    quaternions=_quaternions(picture.force_axes),
                    labels=picture.labels,
                ),
                rr.LineStrips3D.from_fields(strips=picture.rings_m),
            )

    def _draw_curves(self) -> None:
        """Write each patch's normal force and maximum depth; NaN for a patch without a current field."""
        forces_n, depths_um = [], []
        for name in self._rest_m:
            field = None if name in self._stale else self._newest.get(name)
            forces_n.append(
                math.nan if field is None else sum(each.normal_force_n for each in field.contacts)
            )
            depths_um.append(math.nan if field is None else 1e6 * _deepest_m(field))
        total_n = math.nan if all(map(math.isnan, forces_n)) else float(np.nansum(forces_n))
        self._stream.log(window.FORCE, rr.Scalars([*forces_n, total_n]))
        self._stream.log(window.DEPTH, rr.Scalars(depths_um))

    def _draw_state(self, tick: Tick, view: View) -> None:
        conditions = {patch.name: patch.condition for patch in view.patches}
        for name in self._newest:
            if conditions[name] in GONE and name not in self._stale and name not in tick.fields:
                self._stale.add(name)
                self._draw(name, stale_picture_of(self._rest_m[name]))
        loads = {bus.name: 100 * bus.load for bus in view.buses if bus.load is not None}
        log = self._stream.log
        log(window.LOAD, rr.Scalars([loads.get(bus.name, math.nan) for bus in self._hand.buses]))
        log(window.HEALTH, _markdown(health_text(view, tick.counts, self._notes())))
        log(window.CONTACTS, _markdown(contacts_text(self._frame(tick.t_ns, conditions))))

    def _frame(self, t_ns: int, conditions: Mapping[str, str]) -> HandFrame:
        """Return the newest fields as a hand frame, which computes contacts and wrenches."""
        fields = {name: each for name, each in self._newest.items() if name not in self._stale}
        scan = max((each.stamp.scan for each in fields.values() if each.stamp is not None), default=0)
        missing = {name: conditions.get(name, LATE) for name in self._rest_m if name not in fields}
        return HandFrame(scan, t_ns, fields, missing, self._skeleton)

    def _notes(self) -> list[str]:
        shear = SHEAR * self._exaggeration
        notes = [
            f"Displacements are magnified {self._exaggeration:g} times, shear arrows {shear:g} times. "
            f"The brightest colour marks a depth of {1e6 * self._scale.full_m:.0f} µm. "
            f"A force of 1 N is drawn as an arrow {1e3 * FORCE_M_PER_N:g} mm long."
        ]
        if self.placement.side_by_side:
            notes.append("The hand file gives no separate poses: the patches are drawn side by side.")
        return notes

    def _set_time(self, t_ns: int, field: FieldFrame | None = None) -> None:
        wall = np.datetime64(t_ns + self._wall_minus_mono_ns, "ns")
        self._stream.set_time(window.TIME, timestamp=wall)
        if field is not None and field.stamp is not None:
            self._stream.set_time(window.SCAN, sequence=field.stamp.scan)


def _time_ns(field: FieldFrame, otherwise_ns: int) -> int:
    """Return the field's SYNC time or, if unknown, the time of its last frame, in ns."""
    if field.stamp is None:
        return otherwise_ns
    return field.stamp.t_sync_ns or field.stamp.t_receive_ns


def _deepest_m(field: FieldFrame) -> float:
    known = np.isfinite(field.displacement_std_m[..., 2])
    return float(np.max(-field.displacement_m[..., 2], initial=0.0, where=known))


def _transform(pose: Pose) -> rr.Transform3D:
    return rr.Transform3D(translation=pose.position_m, quaternion=rr.Quaternion(xyzw=pose.quaternion_xyzw))


def _quaternions(axes: Float) -> Float:
    """Return the (C, 4) quaternions, real part last, that rotate the coordinate axes to the rows of ``axes``.

    Args:
        axes: (C, 3, 3) axes of each contact, as rows.
    """
    if np.array_equal(axes, np.broadcast_to(np.eye(3), axes.shape)):  # a flat patch
        return np.tile([0.0, 0.0, 0.0, 1.0], (len(axes), 1))
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_matrix(np.swapaxes(axes, 1, 2)).as_quat())


def _markdown(text: str) -> rr.TextDocument:
    return rr.TextDocument(text, media_type=rr.MediaType.MARKDOWN)
