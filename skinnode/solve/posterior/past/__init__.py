"""Filter over the frames of a stream: combines a frame's readings with those of earlier frames.

``frame_filter`` filters the readings before the posterior solve, and decides when earlier frames may be used.
``filter_kernel`` is its compiled part: a bank of Kalman filters for different speeds of the skin.
``load_modes`` contains the directions in which loads change the readings.
"""
