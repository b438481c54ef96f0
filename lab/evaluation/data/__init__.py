"""The data of an evaluation: data sets, pairs of traverses and their truth, disturbances."""
