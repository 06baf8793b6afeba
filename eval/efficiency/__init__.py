"""What uncertainty costs: latency, power, energy and memory, as in the paper's table of the efficiency.

``measure`` takes rows and networks and returns plain values; ``efficiency_table`` draws the paper's table of them.
"""
