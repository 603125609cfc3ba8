"""What a field says about itself in JSON and in the report of `skinnode host`."""

from __future__ import annotations

import dataclasses
import json
import math

import numpy as np

from skinnode.cli._run_report import _patch_text
from skinnode.host.trust_report import trust_table
from skinnode.model.data_fault import DataFault, FaultKind, FaultyPart
from skinnode.model.frames import FieldFrame, SolveStats
from skinnode.model.status import Status

FAULT = DataFault(FaultyPart.CROSSING, FaultKind.CONTRADICTS, 3, 12, since=80, deviations=math.inf)


def a_field(**changes: object) -> FieldFrame:
    displacement_m = np.zeros((2, 3, 3))
    displacement_m[1, 2, 2] = -1e-4
    field = FieldFrame(
        displacement_m,
        np.full((2, 3, 3), 1e-6),
        (Status.CONVERGED, Status.CONVERGED),
        np.zeros(2),
        SolveStats(0, 0, 0, 0.0),
    )
    return dataclasses.replace(field, **changes)


def line_of(field: FieldFrame) -> str:
    facts = {
        "condition": "operational",
        "reason": None,
        "solved": 12,
        "deepest_m": 1e-4,
        "deepest_std_m": 1e-6,
        "noise_factor": 1.0,
    }
    counts = dict.fromkeys(("torn", "corrupt", "missed", "skipped"), 0)
    return _patch_text("palm", {**facts, **counts, **trust_table(field)})


def test_a_sound_field() -> None:
    assert trust_table(a_field()) == {
        "trusted": True,
        "distrust": "",
        "precise": True,
        "deepest_data_share": 1.0,
        "data_faults": [],
    }
    assert line_of(a_field()) == "palm operational  12 fields  deepest 100.0 ± 1.0 µm"


def test_no_field_yet() -> None:
    assert set(trust_table(None).values()) == {None}


def test_a_field_that_is_not_to_be_trusted_says_why() -> None:
    share = np.full((2, 3, 3), 0.25)
    share[1, 2, 2] = 0.75
    field = a_field(
        distrust="half of the readings are lost", precise=False, data_share=share, faults=(FAULT,)
    )
    table = json.loads(json.dumps(trust_table(field), allow_nan=False))
    assert (table["trusted"], table["distrust"]) == (False, "half of the readings are lost")
    assert (table["precise"], table["deepest_data_share"]) == (False, 0.75)
    assert table["data_faults"] == [
        {
            "part": "crossing",
            "kind": "contradicts the other readings",
            "upper": 3,
            "lower": 12,
            "since": 80,
            "deviations": None,  # certain
        }
    ]
    assert line_of(field).endswith("µm  untrusted: half of the readings are lost")


def test_a_trusted_field_without_some_readings() -> None:
    assert line_of(a_field(faults=(FAULT,))).endswith(
        "µm  1 fault in the readings; the affected readings are excluded"
    )
    assert line_of(a_field(precise=False, faults=(FAULT, FAULT))).endswith(
        "imprecise  2 faults in the readings; the affected readings are excluded"
    )
