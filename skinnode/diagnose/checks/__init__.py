"""What is wrong with a hand: facts are gathered from its buses, checks that know nothing of buses draw the
conclusions, a page shows both.
"""
