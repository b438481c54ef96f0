"""Networks and files of other software, read without trust and written as the files that the core runs."""
