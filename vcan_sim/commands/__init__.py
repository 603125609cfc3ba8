"""Commands of ``vcan-sim``, one thin file each. Without the name of a command, ``vcan-sim`` runs a hand."""
