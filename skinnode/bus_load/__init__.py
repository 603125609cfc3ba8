"""How much of a bus a hand needs: ``stuffing`` counts bits, ``timing`` turns frames into seconds,
``response`` bounds the worst-case latency, ``plan`` adds it all up for a hand.
"""
