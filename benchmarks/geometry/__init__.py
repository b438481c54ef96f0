"""What geometric verification brings and costs."""
