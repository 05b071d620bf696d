"""What the search says in the end: verdict, aliases, what cannot be detected, the corrected simulator, tables."""
