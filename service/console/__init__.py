"""The console: pages in the browser for those who look after maps.  It uses the API with the key that a user types.

The pages are plain ES modules and one style sheet, served as they lie here: ``start.js`` and ``frame.js`` are the
frame, ``views`` has one module a view, ``shared`` what several views use, ``vendor`` other people's libraries
(``scripts/vendor`` renews them).  Nothing is built, and nothing is loaded from elsewhere.
"""
