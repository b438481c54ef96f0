"""Systems that reweight the features of a frame by learned attention before they aggregate them."""
