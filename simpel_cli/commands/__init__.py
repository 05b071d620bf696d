"""One file per verb: its words, its help with two examples, and the calls that do its work; what verbs share lies beside."""
