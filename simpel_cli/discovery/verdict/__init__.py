"""The results of a search: verdict, aliases, undetectable effects, the corrected simulator, tables."""
