"""Road networks: highway-env's merge and the tasks after it on one compiled engine, batched over episodes."""
