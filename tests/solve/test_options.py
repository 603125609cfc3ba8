"""Options of the trackers: an object, keyword arguments, or both; checks in one place."""

from __future__ import annotations

import dataclasses
import math
from typing import get_type_hints

import numpy as np
import pytest

import skinnode as sk
from skinnode.solve import options
from skinnode.solve.options import PosteriorArguments, PosteriorOptions, TrackerArguments, TrackerOptions


@pytest.fixture(scope="module")
def layout() -> sk.PatchLayout:
    return sk.PatchLayout.preset("staggered", upper_wires=2, upper_electrodes=3)


@pytest.mark.parametrize(
    ("kind", "arguments"), [(TrackerOptions, TrackerArguments), (PosteriorOptions, PosteriorArguments)]
)
def test_every_option_is_a_keyword_argument_of_the_same_type(kind, arguments):
    """Type checkers see the keyword arguments, users the options: one list."""
    fields = {field.name for field in dataclasses.fields(kind)}
    assert set(arguments.__annotations__) == fields
    assert get_type_hints(arguments) == {name: get_type_hints(kind)[name] for name in fields}


def test_options_and_keywords_give_the_same_tracker_and_keywords_win(layout):
    asked = TrackerOptions(method="exact", relative_noise=1e-4, hold=False)
    by_object, by_name = sk.Tracker(layout, asked), sk.Tracker(layout, method="exact", relative_noise=1e-4)
    assert by_object.options is asked
    assert by_name.options.hold
    both = sk.Tracker(layout, asked, hold=True)
    assert both.options.relative_noise == 1e-4
    assert both.options.hold
    frame = sk.resistance_ohm(layout, layout.upper_m - [0, 0, 1e-4])
    one, two = by_name.update(frame), both.update(frame)
    np.testing.assert_array_equal(one.displacement_m, two.displacement_m)


@pytest.mark.parametrize(
    ("name", "value", "must"),
    [
        ("method", "best", "must be one of auto, exact, posterior"),
        ("drift", "some", "must be one of none, patch, wire"),
        ("past", "on", "must be one of off, auto"),
        ("drift_std", 0.0, "must be positive and finite"),
        ("model_error", -0.1, "must be finite and at least 0"),
        ("deadline_us", math.inf, "must be positive and finite"),
        ("stiffness_n_per_m", 0.0, "must be positive and finite"),
    ],
)
def test_an_option_out_of_range_is_named(layout, name, value, must):
    with pytest.raises(ValueError, match=f"{name}: got .*{must}"):
        sk.Tracker(layout, **{name: value})


def test_a_name_that_is_no_option_and_options_of_another_kind_are_type_errors(layout):
    with pytest.raises(TypeError, match=r"unexpected keyword argument 'nois', must be one of relative_noise"):
        sk.Posterior(layout, nois=1e-4)
    with pytest.raises(TypeError, match="options: got TrackerOptions, must be PosteriorOptions"):
        sk.Posterior(layout, TrackerOptions())
    with pytest.raises(ValueError, match=r"scale_m: got -1\.0, must be positive"):
        sk.Posterior(layout, scale_m=-1.0)
    with pytest.raises(ValueError, match=r"scale_m: got 0\.0001, must be None with prior='discs', because"):
        sk.Posterior(layout, scale_m=1e-4, prior="discs")


def test_of_posterior_takes_over_what_both_have():
    asked = TrackerOptions(drift="wire", drift_std=0.1, normal_only=True, operator="dogleg")
    found = asked.of_posterior()
    for field in dataclasses.fields(options.EstimateOptions):
        assert getattr(found, field.name) == getattr(asked, field.name)
