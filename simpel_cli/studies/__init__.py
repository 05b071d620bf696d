"""One fit as a whole: opened, prepared, its prior checked, trained, tested; and fits with a corrected simulator."""
