"""Layout of the viewer's window: the hand in 3-D, with text beside it and curves below it."""

from __future__ import annotations

from typing import Final

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from skinnode.model.layout import Float
from skinnode.view.placement import ROOT

TIME: Final = "time"
"""Timeline of all entities: the wall-clock time of the SYNC or of the hand's state."""
SCAN: Final = "scan"
"""Timeline of a patch's entities: the scan number."""
FORCE, DEPTH, LOAD = "curves/force", "curves/depth", "curves/load"
CONTACTS, HEALTH, EVENTS = "contacts", "health", "events"
_BACKGROUND: Final = (229, 232, 237)
_CURVES_S: Final = 20
"""Time span shown by the curves, in s."""
_DISTANCE: Final = 0.75
"""Distance of the camera from the hand's centre, as a multiple of the hand's diagonal."""


def blueprint(corners_m: Float, *, live: bool) -> rrb.Blueprint:
    """Return the window layout.

    Args:
        corners_m: (P, 3) points of the hand in its frame, in m; the camera looks at their centre.
        live: Whether the window follows the newest data.
    """
    low, high = corners_m.min(axis=0), corners_m.max(axis=0)
    middle, diagonal = 0.5 * (low + high), float(np.linalg.norm(high - low))
    direction = np.array([0.15, -0.62, 0.77])
    eye = rrb.EyeControls3D(
        kind=rrb.Eye3DKind.Orbital,
        position=middle + _DISTANCE * diagonal * direction / np.linalg.norm(direction),
        look_target=middle,
        eye_up=(0.0, 0.0, 1.0),
    )
    hand = rrb.Spatial3DView(
        origin=ROOT, name="Hand", background=_BACKGROUND, line_grid=False, eye_controls=eye
    )
    columns = rrb.TextLogColumns(
        timeline_columns=[rrb.encodings.TimelineColumn(TIME, visible=False)],
        text_log_columns=[rrb.encodings.TextLogColumn(kind) for kind in ("LogLevel", "Body")],
    )
    texts = rrb.Vertical(
        rrb.TextDocumentView(origin=CONTACTS, name="Contacts and wrenches"),
        rrb.TextDocumentView(origin=HEALTH, name="Health"),
        rrb.TextLogView(origin=EVENTS, name="Events", columns=columns),
        row_shares=[9, 10, 4],
    )
    curves = rrb.Horizontal(
        _curve(FORCE, "Normal force, N"),
        _curve(DEPTH, "Deepest displacement, µm"),
        _curve(LOAD, "Bus load, %", (0.0, 100.0)),
    )
    return rrb.Blueprint(
        rrb.Horizontal(rrb.Vertical(hand, curves, row_shares=[2, 1]), texts, column_shares=[8, 5]),
        rrb.BlueprintPanel(state="hidden"),
        rrb.SelectionPanel(state="hidden"),
        rrb.TopPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline=TIME, play_state="following" if live else "playing"),
        auto_views=False,
    )


def _curve(path: str, name: str, limits: tuple[float, float] | None = None) -> rrb.TimeSeriesView:
    span = rr.VisibleTimeRange(
        TIME,
        start=rr.TimeRangeBoundary.cursor_relative(seconds=-_CURVES_S),
        end=rr.TimeRangeBoundary.cursor_relative(),
    )
    return rrb.TimeSeriesView(
        origin=path,
        name=name,
        axis_y=None if limits is None else rrb.ScalarAxis(range=limits),
        time_ranges=[span],
        plot_legend=rrb.PlotLegend(corner=rrb.Corner2D.LeftTop),
    )
