"""Files as named columns: CSV and Parquet, one or several, and where they lie."""
