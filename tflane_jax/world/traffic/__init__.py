"""Road users: demand, driving, signals, and the tracker that observes them."""
