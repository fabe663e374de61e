"""Tables, statistics and pages made from the records."""
