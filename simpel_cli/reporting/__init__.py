"""What people read: figures (from Parquet only), tables, reports in one file, the screens of the terminal."""
