"""States that were not measured: speeds, and levels behind them, from what was measured."""
