"""Commands of ``vcan-sim``, each in a short file. Without a command name, ``vcan-sim`` runs a hand."""
