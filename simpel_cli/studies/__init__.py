"""One fit as a whole: opened, prepared, its prior checked, trained, judged; the loop closed with a corrected simulator."""
