import java.io.BufferedReader;
import java.io.ByteArrayInputStream;
import java.io.ByteArrayOutputStream;
import java.io.InputStreamReader;
import java.math.BigInteger;
import java.nio.charset.StandardCharsets;
import java.security.KeyFactory;
import java.security.KeyStore;
import java.security.PrivateKey;
import java.security.Security;
import java.security.cert.Certificate;
import java.security.cert.CertificateFactory;
import java.security.cert.X509Certificate;
import java.security.spec.PKCS8EncodedKeySpec;
import java.util.Base64;
import java.util.Collection;
import java.util.Collections;
import java.util.Date;
import java.util.List;

import org.bouncycastle.asn1.ASN1ObjectIdentifier;
import org.bouncycastle.asn1.gm.GMObjectIdentifiers;
import org.bouncycastle.asn1.x509.AlgorithmIdentifier;
import org.bouncycastle.asn1.x509.SubjectKeyIdentifier;
import org.bouncycastle.cert.X509CertificateHolder;
import org.bouncycastle.cert.jcajce.JcaCertStore;
import org.bouncycastle.cms.CMSAlgorithm;
import org.bouncycastle.cms.CMSEnvelopedData;
import org.bouncycastle.cms.CMSEnvelopedDataGenerator;
import org.bouncycastle.cms.CMSProcessableByteArray;
import org.bouncycastle.cms.CMSSignedData;
import org.bouncycastle.cms.CMSSignedDataGenerator;
import org.bouncycastle.cms.RecipientInformation;
import org.bouncycastle.cms.SignerInformation;
import org.bouncycastle.cms.jcajce.JcaSignerInfoGeneratorBuilder;
import org.bouncycastle.cms.jcajce.JcaSimpleSignerInfoVerifierBuilder;
import org.bouncycastle.cms.jcajce.JceCMSContentEncryptorBuilder;
import org.bouncycastle.cms.jcajce.JceKeyTransEnvelopedRecipient;
import org.bouncycastle.cms.jcajce.JceKeyTransRecipientInfoGenerator;
import org.bouncycastle.jce.provider.BouncyCastleProvider;
import org.bouncycastle.operator.ContentSigner;
import org.bouncycastle.operator.DigestCalculatorProvider;
import org.bouncycastle.operator.jcajce.JcaContentSignerBuilder;
import org.bouncycastle.operator.jcajce.JcaDigestCalculatorProviderBuilder;
import org.bouncycastle.tsp.TimeStampRequest;
import org.bouncycastle.tsp.TimeStampResponseGenerator;
import org.bouncycastle.tsp.TimeStampTokenGenerator;

/**
 * Bouncy Castle for the tests: a line with a command and its arguments in base64 comes in, a line with the answer goes
 * out, "ok" and bytes in base64 or "error" and the reason. Everything is done with the settings that its documentation
 * shows, so that what is tested is what Java programs do.
 */
public final class BouncyCastle {
    private static final String BC = "BC";

    private BouncyCastle() {
    }

    public static void main(String[] unused) throws Exception {
        Security.addProvider(new BouncyCastleProvider());
        BufferedReader lines = new BufferedReader(new InputStreamReader(System.in, StandardCharsets.US_ASCII));
        for (String line = lines.readLine(); line != null; line = lines.readLine()) {
            String[] words = line.split(" ");
            byte[][] arguments = new byte[words.length - 1][];
            for (int i = 0; i < arguments.length; i++) {
                arguments[i] = words[i + 1].equals("-") ? null : Base64.getDecoder().decode(words[i + 1]);
            }
            try {
                System.out.println("ok " + Base64.getEncoder().encodeToString(answer(words[0], arguments)));
            } catch (Exception error) {
                System.out.println("error " + String.valueOf(error).replace('\n', ' '));
            }
        }
    }

    private static byte[] answer(String command, byte[][] a) throws Exception {
        switch (command) {
            case "sign":
                return sign(a[0], key(a[1]), certificate(a[2]), new String(a[3], StandardCharsets.US_ASCII));
            case "verify":
                return verify(a[0], certificate(a[1]), a[2]);
            case "encrypt":
                return encrypt(a[0], certificate(a[1]), new String(a[2], StandardCharsets.US_ASCII));
            case "decrypt":
                return decrypt(a[0], key(a[1]));
            case "store":
                return store(key(a[0]), certificate(a[1]), a[2], new String(a[3], StandardCharsets.US_ASCII));
            case "load":
                return load(a[0], a[1]);
            case "stamp":
                return stamp(a[0], key(a[1]), certificate(a[2]), Long.parseLong(new String(a[3])));
            default:
                throw new IllegalArgumentException(command);
        }
    }

    private static PrivateKey key(byte[] pkcs8) throws Exception {
        return KeyFactory.getInstance("EC", BC).generatePrivate(new PKCS8EncodedKeySpec(pkcs8));
    }

    private static X509Certificate certificate(byte[] der) throws Exception {
        return (X509Certificate) CertificateFactory.getInstance("X.509", BC)
                .generateCertificate(new ByteArrayInputStream(der));
    }

    /** SignedData; how: "attached", "detached" or "key" (the signer named by the identifier of its key). */
    private static byte[] sign(byte[] content, PrivateKey key, X509Certificate certificate, String how)
            throws Exception {
        CMSSignedDataGenerator generator = new CMSSignedDataGenerator();
        ContentSigner signer = new JcaContentSignerBuilder("SM3withSM2").setProvider(BC).build(key);
        JcaSignerInfoGeneratorBuilder builder = new JcaSignerInfoGeneratorBuilder(
                new JcaDigestCalculatorProviderBuilder().setProvider(BC).build());
        generator.addSignerInfoGenerator(how.equals("key")
                ? builder.build(signer, identifier(certificate)) : builder.build(signer, certificate));
        generator.addCertificates(new JcaCertStore(Collections.singletonList(certificate)));
        return generator.generate(new CMSProcessableByteArray(content), !how.equals("detached")).getEncoded();
    }

    /** TimeStampResp to a request, of the moment `millis` after 1970. */
    private static byte[] stamp(byte[] request, PrivateKey key, X509Certificate certificate, long millis)
            throws Exception {
        DigestCalculatorProvider digests = new JcaDigestCalculatorProviderBuilder().setProvider(BC).build();
        ContentSigner signer = new JcaContentSignerBuilder("SM3withSM2").setProvider(BC).build(key);
        TimeStampTokenGenerator tokens = new TimeStampTokenGenerator(
                new JcaSignerInfoGeneratorBuilder(digests).build(signer, certificate),
                digests.get(new AlgorithmIdentifier(GMObjectIdentifiers.sm3)), new ASN1ObjectIdentifier("1.2.3.4"));
        tokens.addCertificates(new JcaCertStore(Collections.singletonList(certificate)));
        tokens.setAccuracyMillis(20);
        tokens.setResolution(TimeStampTokenGenerator.R_MILLISECONDS);
        return new TimeStampResponseGenerator(tokens, Collections.singleton(GMObjectIdentifiers.sm3))
                .generate(new TimeStampRequest(request), BigInteger.valueOf(7), new Date(millis)).getEncoded();
    }

    private static byte[] identifier(X509Certificate certificate) throws Exception {
        return SubjectKeyIdentifier.fromExtensions(
                new X509CertificateHolder(certificate.getEncoded()).getExtensions()).getKeyIdentifier();
    }

    /** The content, once each of the signers, all with this certificate, was verified. */
    @SuppressWarnings("unchecked") // SignerId is a raw Selector
    private static byte[] verify(byte[] message, X509Certificate certificate, byte[] content) throws Exception {
        CMSSignedData data = content == null
                ? new CMSSignedData(message) : new CMSSignedData(new CMSProcessableByteArray(content), message);
        Collection<SignerInformation> signers = data.getSignerInfos().getSigners();
        if (signers.isEmpty()) {
            throw new IllegalArgumentException("no signer");
        }
        for (SignerInformation signer : signers) {
            if (data.getCertificates().getMatches(signer.getSID()).size() != 1) {
                throw new IllegalArgumentException("the signer's certificate is not inside");
            }
            if (!signer.verify(new JcaSimpleSignerInfoVerifierBuilder().setProvider(BC).build(certificate))) {
                throw new IllegalArgumentException("a signature does not hold");
            }
        }
        ByteArrayOutputStream written = new ByteArrayOutputStream();
        data.getSignedContent().write(written);
        return written.toByteArray();
    }

    /** EnvelopedData by AES-128-CBC, as it finds no SM4 under the identifier of CBC mode; how: "issuer" or "key", by which the recipient is named. */
    private static byte[] encrypt(byte[] content, X509Certificate certificate, String how) throws Exception {
        AlgorithmIdentifier sm2 = new AlgorithmIdentifier(GMObjectIdentifiers.sm2encrypt_with_sm3);
        CMSEnvelopedDataGenerator generator = new CMSEnvelopedDataGenerator();
        generator.addRecipientInfoGenerator((how.equals("key")
                ? new JceKeyTransRecipientInfoGenerator(identifier(certificate), sm2, certificate.getPublicKey())
                : new JceKeyTransRecipientInfoGenerator(certificate, sm2)).setProvider(BC));
        return generator.generate(new CMSProcessableByteArray(content),
                new JceCMSContentEncryptorBuilder(CMSAlgorithm.AES128_CBC).setProvider(BC).build()).getEncoded();
    }

    private static byte[] decrypt(byte[] message, PrivateKey key) throws Exception {
        Collection<RecipientInformation> recipients =
                new CMSEnvelopedData(message).getRecipientInfos().getRecipients();
        return recipients.iterator().next().getContent(new JceKeyTransEnvelopedRecipient(key).setProvider(BC));
    }

    /** A PKCS#12 file of a key store of this type: "PKCS12" (RC2 and 3DES), "PKCS12-3DES-3DES", and others */
    private static byte[] store(PrivateKey key, X509Certificate certificate, byte[] password, String type)
            throws Exception {
        KeyStore store = KeyStore.getInstance(type, BC);
        store.load(null, null);
        char[] secret = new String(password, StandardCharsets.UTF_8).toCharArray();
        store.setKeyEntry("robot", key, secret, new Certificate[] {certificate});
        ByteArrayOutputStream written = new ByteArrayOutputStream();
        store.store(written, secret);
        return written.toByteArray();
    }

    /** The one key of a PKCS#12 file in PKCS#8, after its certificate. Java's own provider knows no SM2. */
    private static byte[] load(byte[] file, byte[] password) throws Exception {
        KeyStore store = KeyStore.getInstance("PKCS12", BC);
        char[] secret = new String(password, StandardCharsets.UTF_8).toCharArray();
        store.load(new ByteArrayInputStream(file), secret);
        ByteArrayOutputStream written = new ByteArrayOutputStream();
        List<String> names = Collections.list(store.aliases());
        for (String name : names) {
            if (store.isKeyEntry(name)) {
                written.write(store.getCertificate(name).getEncoded());
                written.write(store.getKey(name, secret).getEncoded());
            }
        }
        return written.toByteArray();
    }
}
