"""The search for the answer, in the order of the work: matching, consensus, ranking, confidence."""
