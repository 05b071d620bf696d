"""When each value was measured: latencies, clocks of their own, tables of other sensors; and to which row it belongs."""
