"""Fields keep all their values on the way to another process."""

from __future__ import annotations

import copy
import pickle
from collections.abc import Callable
from dataclasses import fields

import numpy as np
import pytest

from skinnode.model.frames import Contact, FieldFrame, ScanStamp, SolveStats
from skinnode.model.status import Status


def a_field() -> FieldFrame:
    contact = Contact(np.arange(3.0), np.full(3, 0.1), 1e-6, 1e-7, 2.5, 0.2, np.ones(2), np.zeros(2), True)
    return FieldFrame(
        displacement_m=np.arange(18.0).reshape(2, 3, 3),
        displacement_std_m=np.full((2, 3, 3), np.inf),
        status=(Status.CONVERGED, Status.NON_FINITE),
        residual=np.array([0.5, np.nan]),
        stats=SolveStats(3, 2, 1, 0.25),
        stamp=ScanStamp("palm", 7, 8, 9, 10, 11, t_solved_ns=12, run=1),
        contacts=(contact,),
        noise_factor=1.5,
        distrust="wire 1",
        touched=True,
    )


@pytest.mark.parametrize("twin_of", [lambda each: pickle.loads(pickle.dumps(each)), copy.copy, copy.deepcopy])
def test_a_copy_or_pickle_of_a_field_is_complete(twin_of: Callable[[FieldFrame], FieldFrame]) -> None:
    field = a_field()
    twin = twin_of(field)
    assert twin is not field
    pairs = [(field, twin), (field.contacts[0], twin.contacts[0])]
    for before, after in pairs:
        for entry in fields(before):
            if entry.name != "contacts":
                np.testing.assert_equal(getattr(after, entry.name), getattr(before, entry.name))
