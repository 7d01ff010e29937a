"""Reading what data sets store: images, disparity maps, label maps."""
