"""BlazePose: networks that find persons and their key points, and the following of one person."""
