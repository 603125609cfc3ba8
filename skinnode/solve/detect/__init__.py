"""Touch detection: decides, before solving, whether a patch is touched and which frames to solve.

``touch_detector`` makes the decision for each frame. It uses ``touch_test`` (the thresholds of the test
statistic), ``touch_statistic`` (the statistic), ``touch_kernel`` (the compiled part), ``touch_odds`` (the
odds of touch versus no touch), ``held_touch`` (the end of a touch) and ``slow_state`` (the gains and offsets
of an untouched patch). ``gain_drift`` contains the gains' prior, ``gain_kernel`` their compiled Kalman
filter, and ``weighted_chi_squared`` the distribution of the statistic. ``rest_gate`` connects the detector to
the tracker.
"""
