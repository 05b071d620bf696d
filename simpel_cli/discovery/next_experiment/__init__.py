"""Which experiment tells tied causes apart."""
