"""What systems are evaluated on: data sets, pairs of traverses and their truth, disturbances."""
