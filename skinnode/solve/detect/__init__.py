"""Touch detection: decide before solving whether a patch is touched, and which frames need no solve.

``touch_detector`` decides frame by frame. It uses ``touch_test``, the statistic of a frame and its
thresholds, ``touch_kernel``, its compiled part, ``held_touch``, which ends a touch, and ``slow_state``, the
gains and offsets of an untouched patch. ``gain_drift`` contains the prior of the gains and their Kalman
filter, ``weighted_chi_squared`` the distribution of the statistic. ``rest_gate`` connects the detector to the
tracker.
"""
