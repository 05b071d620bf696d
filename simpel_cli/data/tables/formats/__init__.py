"""One kind of file each: CSV, Parquet, MATLAB, HDF5, MCAP, rosbag2."""
