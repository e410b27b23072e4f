"""An avatar in a browser: a folder of plain files, with the page that plays it, for any host."""
