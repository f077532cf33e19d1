def report_html(analysis, diagnosis):
    return "<html><body>"+diagnosis.sentence+"</body></html>"
