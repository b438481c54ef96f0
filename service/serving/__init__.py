"""Between the sockets and the application: connections and their limits, signals, the stop."""
