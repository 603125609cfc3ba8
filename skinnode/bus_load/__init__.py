"""The bandwidth that a hand needs on its buses.

``stuffing`` counts bits, ``timing`` turns frames into seconds, ``response`` bounds the worst-case latency,
and ``plan`` adds everything up for a hand.
"""
