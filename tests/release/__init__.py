"""What a release is made of: chart, versions, licences, figures, and the fixtures that hold its promises."""
