"""One model of an attack on a defended victim, of every track: read from records, compared with its controls."""
