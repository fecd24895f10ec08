from . import report_pictures as report_pictures
