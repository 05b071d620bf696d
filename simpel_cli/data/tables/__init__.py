"""Files as named columns: CSV, Parquet, MATLAB, HDF5 and recordings of robots, one or several, and where they lie."""
