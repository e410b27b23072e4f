"""The web page that plays a package in a browser."""
