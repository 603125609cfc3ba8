"""Touch detection: decide before solving whether a patch is touched, and which frames need no solve.

``touch_detector`` decides for each frame. It uses ``touch_test`` (the test statistic and its thresholds),
``touch_kernel`` (the compiled part), ``held_touch`` (the end of a touch) and ``slow_state`` (the gains and
offsets of an untouched patch). ``gain_drift`` contains the gains' prior and Kalman filter, and
``weighted_chi_squared`` contains the distribution of the statistic. ``rest_gate`` connects the detector to
the tracker.
"""
