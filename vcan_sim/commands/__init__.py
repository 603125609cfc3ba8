"""Commands of ``vcan-sim``, one thin file each. Without a command name, ``vcan-sim`` runs a hand."""
