"""The laboratory's commands of ``placerec``: evaluate, model, vocabulary."""
