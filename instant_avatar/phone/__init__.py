"""ia-capture: a page that films with the phone's own browser, or takes its films."""
